# SPDX-License-Identifier: Apache-2.0
"""stereovox's laboratory: papers reproduced, benchmarks, missions and checks. The product does not need it."""

from stereovox_lab.flights.campaign import explore as explore
from stereovox_lab.flights.explore import Cruise as Cruise
