// SPDX-License-Identifier: Apache-2.0
// Bonxai's ProbabilisticMap with its own settings, which are those of OctoMap.
#include "peer.h"

#include <limits>
#include <vector>

#include <bonxai_map/probabilistic_map.hpp>

namespace {

struct Map {
  Map(double voxel_size, double range)
      : grid(voxel_size), max_range(range > 0 ? range : std::numeric_limits<double>::max()) {}
  Bonxai::ProbabilisticMap grid;
  double max_range;
  std::vector<Eigen::Vector3d> points;
  Eigen::Vector3d origin;
};

}  // namespace

extern "C" {

const char* peer_about() { return "Bonxai, C++, ProbabilisticMap::insertPointCloud"; }

void* peer_new(double voxel_size, double max_range) {
  void* made = nullptr;
  peer::guarded([&] { made = new Map(voxel_size, max_range); });
  return made;
}

void peer_free(void* map) { delete static_cast<Map*>(map); }

int peer_load(void* map, const double* points, int64_t count, const double* origin) {
  auto& self = *static_cast<Map*>(map);
  return peer::guarded([&] {
    self.points.resize(count);
    for (int64_t i = 0; i < count; ++i) self.points[i] = {points[3 * i], points[3 * i + 1], points[3 * i + 2]};
    self.origin = {origin[0], origin[1], origin[2]};
  });
}

int peer_insert(void* map) {
  auto& self = *static_cast<Map*>(map);
  return peer::guarded([&] { self.grid.insertPointCloud(self.points, self.origin, self.max_range); });
}

int peer_cells(void* map, int64_t* occupied, int64_t* free) {
  auto& self = *static_cast<Map*>(map);
  return peer::guarded([&] {
    std::vector<Bonxai::CoordT> cells;
    self.grid.getOccupiedVoxels(cells);
    *occupied = static_cast<int64_t>(cells.size());
    cells.clear();
    self.grid.getFreeVoxels(cells);
    *free = static_cast<int64_t>(cells.size());
  });
}

int64_t peer_bytes(void* map) { return static_cast<int64_t>(static_cast<Map*>(map)->grid.grid().memUsage()); }
}
