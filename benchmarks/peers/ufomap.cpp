// SPDX-License-Identifier: Apache-2.0
// UFOMap with its own settings, which are those of OctoMap; points that share a cell become one ray, as its server does.
#include "peer.h"

#include <ufo/map/occupancy_map.h>
#include <ufo/map/point_cloud.h>

namespace {

struct Map {
  Map(double voxel_size, double range) : tree(voxel_size), max_range(range > 0 ? range : -1) {}
  ufo::map::OccupancyMap tree;
  double max_range;
  ufo::map::PointCloud cloud;
  ufo::map::Point3 origin;
};

}  // namespace

extern "C" {

const char* peer_about() { return "UFOMap 1, C++, insertPointCloudDiscrete"; }

void* peer_new(double voxel_size, double max_range) {
  void* made = nullptr;
  peer::guarded([&] { made = new Map(voxel_size, max_range); });
  return made;
}

void peer_free(void* map) { delete static_cast<Map*>(map); }

int peer_load(void* map, const double* points, int64_t count, const double* origin) {
  auto& self = *static_cast<Map*>(map);
  return peer::guarded([&] {
    self.cloud.clear();
    self.cloud.reserve(count);
    for (int64_t i = 0; i < count; ++i) {
      self.cloud.push_back(ufo::map::Point3(points[3 * i], points[3 * i + 1], points[3 * i + 2]));
    }
    self.origin = ufo::map::Point3(origin[0], origin[1], origin[2]);
  });
}

int peer_insert(void* map) {
  auto& self = *static_cast<Map*>(map);
  return peer::guarded([&] { self.tree.insertPointCloudDiscrete(self.origin, self.cloud, self.max_range); });
}

int peer_cells(void* map, int64_t* occupied, int64_t* free) {
  auto& self = *static_cast<Map*>(map);
  return peer::guarded([&] {
    *occupied = *free = 0;
    for (auto leaf = self.tree.beginLeaves(true, true, false), end = self.tree.endLeaves(); leaf != end; ++leaf) {
      *(leaf.isOccupied() ? occupied : free) += int64_t(1) << (3 * leaf.getDepth());
    }
  });
}

int64_t peer_bytes(void* map) { return static_cast<int64_t>(static_cast<Map*>(map)->tree.memoryUsage()); }
}
