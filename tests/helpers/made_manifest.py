# SPDX-License-Identifier: Apache-2.0
"""Manifests that were changed by somebody who knows how they are sealed."""

from stereovox.files.safe_io import sealed, unsealed
from stereovox.maps.files.store import as_number


def manifest_in(file):
    """What a manifest says."""
    return unsealed(file.read_bytes())


def put_manifest(file, values):
    file.write_bytes(sealed(values, as_number, 2))


def change_manifest(file, **keys):
    put_manifest(file, {**manifest_in(file), **keys})
