// SPDX-License-Identifier: Apache-2.0
// wavemap's hashed, chunked wavelet octree, one worker thread; for images with the settings of its Python example, for
// clouds of a turning lidar with those of its Ouster's configuration.
#include "peer.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <memory>
#include <optional>

#include <wavemap/core/integrator/measurement_model/continuous_beam.h>
#include <wavemap/core/integrator/measurement_model/continuous_ray.h>
#include <wavemap/core/integrator/projection_model/pinhole_camera_projector.h>
#include <wavemap/core/integrator/projection_model/spherical_projector.h>
#include <wavemap/core/integrator/projective/coarse_to_fine/hashed_chunked_wavelet_integrator.h>
#include <wavemap/core/map/hashed_chunked_wavelet_octree.h>

namespace {

using namespace wavemap;

constexpr FloatingPoint kNearest = 0.1f;      // nearer ones, and so zeros, have no value for wavemap
constexpr FloatingPoint kNearestOfLidar = 1.0f;
constexpr FloatingPoint kBeamSigma = 0.035f * static_cast<FloatingPoint>(M_PI) / 180.0f;
constexpr FloatingPoint kNoEvidence = 1e-6f;  // log-odds nearer to zero: cells are sums of wavelets

struct Lens {
  int width = 0, height = 0;
  float fx = 0, fy = 0, cx = 0, cy = 0;
  bool operator==(const Lens& o) const {
    return width == o.width && height == o.height && fx == o.fx && fy == o.fy && cx == o.cx && cy == o.cy;
  }
};

struct Map {
  Map(double size, double range) : workers(std::make_shared<ThreadPool>(1)), voxel_size(size), max_range(range) {
    HashedChunkedWaveletOctreeConfig config;
    config.min_cell_width = static_cast<FloatingPoint>(voxel_size);
    octree = std::make_shared<HashedChunkedWaveletOctree>(config);
  }

  // The integrator is made for a camera and a range, and kept while both stay.
  void use(const Lens& now, float reach) {
    if (integrator && lens == now && reach <= used_reach) return;
    lens = now;
    used_reach = reach;
    auto projector = std::make_shared<PinholeCameraProjector>(
        PinholeCameraProjectorConfig(now.fx, now.fy, now.cx, now.cy, now.height, now.width));
    auto image = std::make_shared<PosedImage<>>(projector->getDimensions());
    auto offsets = std::make_shared<Image<Vector2D>>(projector->getDimensions());
    auto model = std::make_shared<ContinuousRay>(ContinuousRayConfig(0.01f, 0.2f, 0.4f), projector, image);
    integrator.emplace(ProjectiveIntegratorConfig(kNearest, reach), projector, image, offsets, model, octree, workers);
  }

  // The same for clouds of a lidar that turns about z: lowest and highest elevation in radians, rows, columns.
  void use(const std::array<double, 4>& now) {
    if (clouds && turning == now) return;
    turning = now;
    const CircularProjectorConfig elevation(now[0], now[1], static_cast<IndexElement>(now[2]));
    const CircularProjectorConfig azimuth(-M_PI, M_PI, static_cast<IndexElement>(now[3]));
    auto projector = std::make_shared<SphericalProjector>(SphericalProjectorConfig(elevation, azimuth));
    auto image = std::make_shared<PosedImage<>>(projector->getDimensions());
    auto offsets = std::make_shared<Image<Vector2D>>(projector->getDimensions());
    const auto sigma = std::max(static_cast<FloatingPoint>(voxel_size) / 2, 0.05f);  // as its configuration advises
    auto model = std::make_shared<ContinuousBeam>(ContinuousBeamConfig(kBeamSigma, sigma, 0.2f, 0.4f), projector,
                                                  image, offsets);
    const auto reach = static_cast<FloatingPoint>(max_range > 0 ? max_range : 1000);
    clouds.emplace(ProjectiveIntegratorConfig(kNearestOfLidar, reach), projector, image, offsets, model, octree,
                   workers);
  }

  HashedChunkedWaveletOctree::Ptr octree;
  std::shared_ptr<ThreadPool> workers;
  double voxel_size, max_range;
  std::array<double, 4> turning{};
  std::optional<HashedChunkedWaveletIntegrator> clouds;
  std::optional<PosedPointcloud<>> given_cloud;
  Lens lens;
  float used_reach = 0;
  std::optional<HashedChunkedWaveletIntegrator> integrator;
  std::optional<PosedImage<>> given;
};

Transformation3D transform(const double* pose) {
  const Eigen::Matrix4d T = Eigen::Map<const Eigen::Matrix<double, 4, 4, Eigen::RowMajor>>(pose);
  const Eigen::Quaterniond turn(Eigen::Matrix3d(T.block<3, 3>(0, 0)));
  return Transformation3D(Rotation3D(turn.normalized().cast<FloatingPoint>()),
                          Point3D(T.block<3, 1>(0, 3).cast<FloatingPoint>()));
}

}  // namespace

extern "C" {

const char* peer_about() { return "wavemap, C++, hashed chunked wavelet octree, continuous ray"; }

void* peer_new(double voxel_size, double max_range) {
  void* made = nullptr;
  peer::guarded([&] { made = new Map(voxel_size, max_range); });
  return made;
}

void peer_free(void* map) { delete static_cast<Map*>(map); }

int peer_load_image(void* map, const float* depth_m, int width, int height, const double* lens, const double* pose) {
  auto& self = *static_cast<Map*>(map);
  return peer::guarded([&] {
    const Eigen::Map<const Eigen::MatrixXf> pixels(depth_m, width, height);  // by columns, so that its rows are u
    const float reach = self.max_range > 0 ? static_cast<float>(self.max_range) : std::ceil(pixels.maxCoeff());
    self.use({width, height, static_cast<float>(lens[0]), static_cast<float>(lens[1]), static_cast<float>(lens[2]),
              static_cast<float>(lens[3])}, reach);
    self.given.emplace(transform(pose), Image<>::Data(pixels));
  });
}

int peer_insert_image(void* map) {
  auto& self = *static_cast<Map*>(map);
  return peer::guarded([&] { self.integrator->integrate(*self.given); });
}

int peer_load_cloud(void* map, const double* points, int64_t count, const double* pose, const double* turning) {
  auto& self = *static_cast<Map*>(map);
  return peer::guarded([&] {
    self.use({turning[0], turning[1], turning[2], turning[3]});
    const Eigen::Map<const Eigen::Matrix<double, 3, Eigen::Dynamic>> given(points, 3, count);
    Eigen::Matrix<FloatingPoint, 3, Eigen::Dynamic> cloud = given.cast<FloatingPoint>();
    self.given_cloud.emplace(transform(pose), Pointcloud<>(cloud));
  });
}

int peer_insert_cloud(void* map) {
  auto& self = *static_cast<Map*>(map);
  return peer::guarded([&] { self.clouds->integrate(*self.given_cloud); });
}

int peer_log_odds(void* map, const double* points, int64_t count, float* log_odds) {
  auto& self = *static_cast<Map*>(map);
  return peer::guarded([&] {
    for (int64_t k = 0; k < count; ++k, points += 3) {
      Index3D cell;
      for (int axis = 0; axis < 3; ++axis) cell[axis] = static_cast<IndexElement>(std::floor(points[axis] / self.voxel_size));
      log_odds[k] = self.octree->getCellValue(cell);
    }
  });
}

int peer_cells(void* map, int64_t* occupied, int64_t* free) {
  auto& self = *static_cast<Map*>(map);
  return peer::guarded([&] {
    *occupied = *free = 0;
    self.octree->forEachLeaf([&](const OctreeIndex& index, FloatingPoint value) {
      const int64_t cells = int64_t(1) << (3 * index.height);
      if (value > kNoEvidence) *occupied += cells;
      if (value < -kNoEvidence) *free += cells;
    });
  });
}

int64_t peer_bytes(void* map) { return static_cast<int64_t>(static_cast<Map*>(map)->octree->getMemoryUsage()); }
}
