// SPDX-License-Identifier: Apache-2.0
// OctoMap with its own settings: points that share a cell become one ray, inner nodes are kept up to date.
#include "peer.h"

#include <octomap/octomap.h>

namespace {

struct Map {
  explicit Map(double voxel_size, double range) : tree(voxel_size), max_range(range > 0 ? range : -1) {}
  octomap::OcTree tree;
  double max_range;
  octomap::Pointcloud cloud;
  octomap::point3d origin;
};

}  // namespace

extern "C" {

const char* peer_about() { return "OctoMap, C++, insertPointCloud, discretised"; }

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
    for (int64_t i = 0; i < count; ++i) self.cloud.push_back(points[3 * i], points[3 * i + 1], points[3 * i + 2]);
    self.origin = octomap::point3d(origin[0], origin[1], origin[2]);
  });
}

int peer_insert(void* map) {
  auto& self = *static_cast<Map*>(map);
  return peer::guarded([&] { self.tree.insertPointCloud(self.cloud, self.origin, self.max_range, false, true); });
}

int peer_cells(void* map, int64_t* occupied, int64_t* free) {
  auto& self = *static_cast<Map*>(map);
  return peer::guarded([&] {
    *occupied = *free = 0;
    for (auto leaf = self.tree.begin_leafs(); leaf != self.tree.end_leafs(); ++leaf) {
      const int64_t cells = int64_t(1) << (3 * (self.tree.getTreeDepth() - leaf.getDepth()));
      *(self.tree.isNodeOccupied(*leaf) ? occupied : free) += cells;
    }
  });
}

int64_t peer_bytes(void* map) { return static_cast<int64_t>(static_cast<Map*>(map)->tree.memoryUsage()); }
}
