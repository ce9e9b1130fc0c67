# SPDX-License-Identifier: Apache-2.0
"""Kernel that sums the constraints of landmarks on the pose of the camera that sees them."""

from stereovox.kernels._jit import kernel


@kernel
def equations(
    centre, ray, inverse, variance, measured, deviation, lens, R, t, pixel, alike, reach, work, information, gradient
):
    """Fill the normal equations of a small motion (rotation about the camera, then shift, in the map's axes).

    The residuals of `sightings.Sightings.residuals`, weighted by their inverse covariance, by `alike` and by Geman and
    McClure's function of `reach` squared deviations. All float64.

    centre, ray (N, 3), inverse, variance (N,): the landmarks. measured (N, 3), deviation (N,): where they are found.
    lens (4,): fx, fy, cx, cy. R (3, 3), t (3,): T_world_camera. pixel: standard deviation of a corner's position.
    Written: work (6, 3, 6), information (6, 6), gradient (6,).
    """
    information[:], gradient[:] = 0.0, 0.0
    fx, fy, cx, cy = lens
    work[0] = 0.0
    by_place, by_world, by_motion, weighted = work[0], work[1], work[2], work[3]
    arm, q, off, by_inverse, scaled, own = work[4, 0], work[4, 1], work[4, 2], work[5, 0], work[5, 1], work[5, 2]
    own[0], own[1] = 2 * pixel * pixel, 2 * pixel * pixel
    for i in range(inverse.shape[0]):
        rho = inverse[i]
        for k in range(3):
            arm[k] = centre[i, k] - t[k]
            q[k] = rho * arm[k] + ray[i, k]
        x = q[0] * R[0, 0] + q[1] * R[1, 0] + q[2] * R[2, 0]
        y = q[0] * R[0, 1] + q[1] * R[1, 1] + q[2] * R[2, 1]
        z = max(q[0] * R[0, 2] + q[1] * R[1, 2] + q[2] * R[2, 2], 1e-3)
        off[0] = measured[i, 0] - (fx * x / z + cx)
        off[1] = measured[i, 1] - (fy * y / z + cy)
        off[2] = measured[i, 2] - rho / z
        by_place[0, 0], by_place[0, 2] = fx / z, -fx * x / z**2
        by_place[1, 1], by_place[1, 2] = fy / z, -fy * y / z**2
        by_place[2, 2] = -rho / z**2
        spread = 0.0  # of the landmark's own distance, in measurement variances
        for j in range(3):
            for k in range(3):
                by_world[j, k] = by_place[j, 0] * R[k, 0] + by_place[j, 1] * R[k, 1] + by_place[j, 2] * R[k, 2]
            w0, w1, w2 = by_world[j, 0], by_world[j, 1], by_world[j, 2]
            by_motion[j, 0], by_motion[j, 1] = w1 * q[2] - w2 * q[1], w2 * q[0] - w0 * q[2]
            by_motion[j, 2] = w0 * q[1] - w1 * q[0]
            by_motion[j, 3], by_motion[j, 4], by_motion[j, 5] = -rho * w0, -rho * w1, -rho * w2
            by_inverse[j] = w0 * arm[0] + w1 * arm[1] + w2 * arm[2]
        by_inverse[2] += 1 / z
        own[2] = deviation[i] * deviation[i]
        for j in range(3):
            scaled[j] = by_inverse[j] / own[j]
            spread += by_inverse[j] * scaled[j]
        share = variance[i] / (1 + variance[i] * spread)  # Sherman and Morrison 1950
        squares, along = 0.0, 0.0
        for j in range(3):
            along += scaled[j] * off[j]
        for j in range(3):
            squares += off[j] * off[j] / own[j]
        squares -= share * along * along
        weight = 1 / (alike * (1 + squares / reach) ** 2)
        for k in range(6):
            common = 0.0
            for j in range(3):
                common += scaled[j] * by_motion[j, k]
            for j in range(3):
                weighted[j, k] = weight * (by_motion[j, k] / own[j] - share * scaled[j] * common)
        for k in range(6):
            for j in range(3):
                gradient[k] += weighted[j, k] * off[j]
                for m in range(6):
                    information[k, m] += weighted[j, k] * by_motion[j, m]
