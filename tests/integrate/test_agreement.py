"""Projective maps against maps of exact rays with one update a cell a frame."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

import stereovox as sv
from stereovox.evaluate.agreement import agreement
from stereovox.sources.simulation import Simulation

KITCHEN = Path(__file__).resolve().parents[2] / "../shared/data/sevenscenes_redkitchen"


@cache
def frames_of(name):
    return list(sv.open_source(KITCHEN, "::5")) if name == "kitchen" else list(sv.open_source("sim:room", ":60:3"))


def maps_of(frames, voxel_size):
    settings = {"voxel_size": voxel_size, "max_range": 4.5}
    mappers = [
        sv.Mapper("default", **settings),
        sv.Mapper("default", integrator="ray", **{"ray.update": "once"}, **settings),
    ]
    for frame in frames:
        for mapper in mappers:
            assert mapper.add(frame).refused is None
    return [mapper.map for mapper in mappers]


@pytest.mark.skipif(not KITCHEN.is_dir(), reason=f"recording {KITCHEN.name} is not here")
@pytest.mark.parametrize("voxel_size", [0.2, 0.1, 0.05])
def test_recording(voxel_size):
    shares = agreement(*maps_of(frames_of("kitchen"), voxel_size))
    assert min(shares["precision"], shares["recall"]) >= 0.97, shares
    assert min(shares["precision_1"], shares["recall_1"]) >= 0.995, shares
    assert shares["wrongly_free"] <= 0.005, shares


@pytest.mark.parametrize("voxel_size", [0.1])
def test_simulated_room(voxel_size):
    """Noise of a D435 is several times a Kinect's, so surface cells change their state more often."""
    shares = agreement(*maps_of(frames_of("room"), voxel_size))
    assert min(shares["precision"], shares["recall"]) >= 0.97, shares
    assert min(shares["precision_1"], shares["recall_1"]) >= 0.995, shares
    assert shares["wrongly_free"] <= 0.005, shares


def test_agreement_by_hand():
    config = sv.load_config(voxel_size=0.1)
    ours = sv.VoxelMap.from_cells(config, [[0, 0, 0], [1, 0, 0], [9, 0, 0], [5, 5, 5]], [2, 2, 2, -1.5])
    theirs = sv.VoxelMap.from_cells(config, [[0, 0, 0], [2, 0, 0], [5, 5, 5]], [2, 2, 2])
    shares = agreement(ours, theirs)
    assert shares["precision"] == pytest.approx(1 / 3)
    assert shares["recall"] == pytest.approx(1 / 3)
    assert shares["precision_1"] == pytest.approx(2 / 3)
    assert shares["recall_1"] == pytest.approx(2 / 3)
    assert shares["wrongly_free"] == pytest.approx(1 / 3)
    assert (shares["free_precision"], shares["free_recall"]) == (0, 1)
    assert np.isfinite(list(agreement(sv.VoxelMap(config), ours).values())).all()


def test_the_simulation_is_at_hand():
    assert len(Simulation()) >= 150
