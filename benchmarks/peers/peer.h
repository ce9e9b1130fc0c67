// SPDX-License-Identifier: Apache-2.0
// What `stereovox bench` calls in the library of a peer; src/stereovox_lab/bench/native.py is the other side.
//
// A function that returns int returns 0, or 1 after an error, which `peer_error` names. One map is used by one thread.
// A library that takes points has peer_load and peer_insert, one that takes images peer_load_image and
// peer_insert_image, one that takes clouds of a turning lidar peer_load_cloud, peer_insert_cloud and peer_log_odds.
// Only the `insert` are timed: `load` puts what is given into the library's own types.
#pragma once

#include <cstdint>
#include <exception>
#include <string>

extern "C" {
// The library, and how it is set, for people.
const char* peer_about();
const char* peer_error();

// A map with cells of so many metres. What is farther than max_range metres clears space up to there; 0: no such limit.
void* peer_new(double voxel_size, double max_range);
void peer_free(void* map);

// points: (count, 3) metres in the world; origin: (3,) where the camera is.
int peer_load(void* map, const double* points, int64_t count, const double* origin);
int peer_insert(void* map);

// depth_m: (height, width) metres along the optical axis, 0: no value. lens: fx, fy, cx, cy, the middle of the first
// pixel being 0, 0. pose: (4, 4) by rows, the optical frame in the world.
int peer_load_image(void* map, const float* depth_m, int width, int height, const double* lens, const double* pose);
int peer_insert_image(void* map);

// points: (count, 3) metres along the lidar's axes, z being that which it turns about. pose: (4, 4) by rows, the lidar in
// the world. turning: lowest and highest elevation in radians, number of beams above each other and of directions.
int peer_load_cloud(void* map, const double* points, int64_t count, const double* pose, const double* turning);
int peer_insert_cloud(void* map);
// log_odds: (count,), of the cells that points (count, 3) in the world lie in; 0: nothing known.
int peer_log_odds(void* map, const double* points, int64_t count, float* log_odds);

// Occupied and free cells of the smallest size, and the bytes that the library says it uses.
int peer_cells(void* map, int64_t* occupied, int64_t* free);
int64_t peer_bytes(void* map);
}

namespace peer {

inline std::string& last_error() {
  static std::string text;
  return text;
}

// Run a function; no exception may leave through C.
template <class Function>
int guarded(Function function) {
  try {
    function();
    return 0;
  } catch (const std::exception& error) {
    last_error() = error.what();
  } catch (...) {
    last_error() = "an error without a name";
  }
  return 1;
}

}  // namespace peer

extern "C" inline __attribute__((used, visibility("default"))) const char* peer_error() {
  return peer::last_error().c_str();
}
