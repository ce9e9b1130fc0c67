# SPDX-License-Identifier: Apache-2.0
"""What Python users expect: names that complete, types that are found, objects that say what is in them."""

from importlib.resources import files

import numpy as np

import stereovox as sv


def test_all_public_names_complete():
    assert set(sv.__all__) <= set(dir(sv))
    assert "import_module" in dir(sv)  # as a module without `__dir__` has it


def test_types_are_found():
    assert files("stereovox").joinpath("py.typed").is_file()


def test_objects_say_what_is_in_them():
    mapper = sv.Mapper(voxel_size=0.2)
    assert repr(mapper.map).startswith(
        "<VoxelMap of 0.2 m cells: 0 free, 0 tentative, 0 occupied; 0 frames, 0 refused; "
    )
    for frame in sv.open_source("sim:room?image_width=160", frames=":3"):
        mapper.add(frame)
    counts = mapper.map.counts()
    said = repr(mapper)
    assert said.startswith("<Mapper: profile 'default'; <VoxelMap of 0.2 m cells: ")
    assert (
        f"{counts['free']:,} free, {counts['tentative']:,} tentative, {counts['occupied']:,} occupied; 3 frames" in said
    )
    assert repr(sv.VoxelMap(sv.load_config(steps=(0.1, 0.1, 0.05), voxel_size=0.1))).startswith(
        "<VoxelMap of 0.1 x 0.1 x 0.05 m"
    )
    field = sv.DistanceField(mapper.map, (0, 0, 0), (2, 1, 1), max_distance=1.0)
    assert repr(field) == "<DistanceField of 10 x 5 x 5 cells of 0.2 x 0.2 x 0.2 m>"
    floor = sv.GridMapper(voxel_size=0.1)
    floor.add(sv.Scan(np.full(90, 2.0, np.float32), -1.5, 0.03, 0.1, 4.0, np.eye(4)))
    assert repr(floor).startswith("<GridMapper: profile 'default'; <GridMap of 0.1 m cells: ")
    assert "1 frames, 0 refused" in repr(floor)
