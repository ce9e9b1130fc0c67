# SPDX-License-Identifier: Apache-2.0
"""Kernels that read OctoMap's node streams.

Pending branches are on a stack as (lowest cell x, y, z; height): a node of height h is 2^h cells wide. Children are
pushed last first, so that they are popped in file order; a stack never holds more than 7 siblings a level and one node.
"""

import numpy as np

from stereovox.kernels._jit import allocating_kernel, kernel

HEIGHT = 16
STACK = 8 * HEIGHT
BLOCK_HEIGHT = 3


@allocating_kernel
def read_binary_leaves(records, corners, heights, occupied):
    """Read the leaves of a `.bt` tree from its branches (n,) uint16; return their number.

    Writes lowest cells (m, 3) int32, heights (m,) and occupied (m,) bool. Raises ValueError if the stream is invalid.
    """
    stack = np.empty((STACK, 4), np.int32)
    stack[0, :3] = -(1 << (HEIGHT - 1))
    stack[0, 3] = HEIGHT
    waiting, record, leaves = 1, 0, 0
    while waiting > 0:
        waiting -= 1
        x, y, z = stack[waiting, 0], stack[waiting, 1], stack[waiting, 2]
        height = stack[waiting, 3] - 1
        if record >= records.size:
            raise ValueError("it ends too early")
        children = records[record]
        record += 1
        if children == 0:
            raise ValueError("a branch without children")
        for child in range(7, -1, -1):
            kind = (children >> (2 * child)) & 3
            if kind == 0:
                continue
            if kind == 3 and height == 0:
                raise ValueError("more than 16 levels")
            if kind < 3 and leaves >= heights.size:
                raise ValueError("more nodes than its header declares")
            corner = stack[waiting] if kind == 3 else corners[leaves]
            corner[0] = x + ((child & 1) << height)
            corner[1] = y + (((child >> 1) & 1) << height)
            corner[2] = z + ((child >> 2) << height)
            if kind == 3:
                stack[waiting, 3] = height
                waiting += 1
            else:
                heights[leaves] = height
                occupied[leaves] = kind == 2
                leaves += 1
    if record < records.size:
        raise ValueError("bytes after the last node")
    return leaves


@allocating_kernel
def read_tree_leaves(children, corners, heights, records):
    """Read the leaves of an `.ot` tree from its nodes' child bits (n,) uint8; return their number.

    Writes lowest cells (m, 3) int32, heights (m,) and the index of the node in the file (m,).
    Raises ValueError if the stream is invalid.
    """
    stack = np.empty((STACK, 4), np.int32)
    stack[0, :3] = -(1 << (HEIGHT - 1))
    stack[0, 3] = HEIGHT
    waiting, record, leaves = 1, 0, 0
    while waiting > 0:
        waiting -= 1
        x, y, z, height = stack[waiting, 0], stack[waiting, 1], stack[waiting, 2], stack[waiting, 3]
        if record >= children.size:
            raise ValueError("it ends too early")
        bits = children[record]
        if bits == 0:
            corners[leaves, 0], corners[leaves, 1], corners[leaves, 2] = x, y, z
            heights[leaves] = height
            records[leaves] = record
            leaves += 1
        elif height == 0:
            raise ValueError("more than 16 levels")
        half = height - 1
        for child in range(7, -1, -1):
            if (bits >> child) & 1:
                stack[waiting, 0] = x + ((child & 1) << half)
                stack[waiting, 1] = y + (((child >> 1) & 1) << half)
                stack[waiting, 2] = z + ((child >> 2) << half)
                stack[waiting, 3] = half
                waiting += 1
        record += 1
    if record < children.size:
        raise ValueError("bytes after the last node")
    return leaves


@kernel
def fill_blocks(corners, heights, units, coords, values):
    """Write leaves into blocks of 8x8x8 cells: coordinates (b, 3), values (b, 512) that were zero; return b.

    Leaves that share a block are consecutive.
    """
    block = -1
    for leaf in range(heights.size):
        x, y, z = corners[leaf, 0], corners[leaf, 1], corners[leaf, 2]
        bx, by, bz = x >> BLOCK_HEIGHT, y >> BLOCK_HEIGHT, z >> BLOCK_HEIGHT
        if heights[leaf] >= BLOCK_HEIGHT:
            side = 1 << (heights[leaf] - BLOCK_HEIGHT)
            for i in range(side):
                for j in range(side):
                    for k in range(side):
                        block += 1
                        coords[block, 0], coords[block, 1], coords[block, 2] = bx + i, by + j, bz + k
                        values[block] = units[leaf]
            continue
        if block < 0 or coords[block, 0] != bx or coords[block, 1] != by or coords[block, 2] != bz:
            block += 1
            coords[block, 0], coords[block, 1], coords[block, 2] = bx, by, bz
        side = 1 << heights[leaf]
        low = ((x & 7) << 6) | ((y & 7) << 3) | (z & 7)
        for i in range(side):
            for j in range(side):
                for k in range(side):
                    values[block, low + ((i << 6) | (j << 3) | k)] = units[leaf]
    return block + 1
