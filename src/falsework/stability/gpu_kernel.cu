// Stability of partial structures, one state a thread block, on chip from the first iteration to the proof.
//
// The mathematics is that of the solver on the processor (admm.py, interior.py, judge.py); two choices differ.
// Velocities and wrenches stay in the world's frame about the centres of mass instead of being whitened: S is
// then L S L^T, its solution is the virtual velocity itself, and the map of a contact point needs 12 numbers and
// the map of a pair 6 instead of 18 and 72. Factor and solves run by levels of the elimination tree.
//
// Compiled at run time for the device at hand. Without CUDA the file is plain C++ with one thread a block: every
// phase between two barriers is a loop with the stride of the block, so the same code then runs in sequence.

#ifndef PHASE_INLINE
#define PHASE_INLINE __forceinline__
#endif
#ifdef __CUDACC__
typedef unsigned char uint8_t;
typedef signed char int8_t;
typedef unsigned short uint16_t;
typedef unsigned int uint32_t;
#define TID int(threadIdx.x)
#define THREADS int(blockDim.x)
#define BLOCK int(blockIdx.x)
#define SYNC __syncthreads()
#define DEVICE static __device__ __forceinline__
#define PHASE static __device__ PHASE_INLINE
#define METHOD __device__ __forceinline__
#define KERNEL(bounds) extern "C" __global__ void __launch_bounds__ bounds
#define POPCOUNT __popc
template <class T>
DEVICE T load(const T* p) {
  return __ldg(p);
}
extern __shared__ double2 dynamic_pool[];
#define POOL reinterpret_cast<char*>(dynamic_pool)
#else
#include <cmath>
#include <cstdint>
#include <cstddef>
#define TID 0
#define THREADS 1
#define BLOCK 0
#define SYNC
#define DEVICE static inline
#define PHASE static
#define METHOD inline
#define KERNEL(bounds) extern "C" void
#define POPCOUNT __builtin_popcount
#define __shared__ static thread_local
using std::copysign;
using std::fabs;
using std::fmax;
using std::fmin;
using std::sqrt;
template <class T>
DEVICE T load(const T* p) {
  return *p;
}
DEVICE int atomicAdd(int* p, int value) {
  int old = *p;
  *p += value;
  return old;
}
alignas(16) static thread_local char host_pool[256 * 1024];
#define POOL host_pool
#endif

#ifndef QUADRATIC
#define QUADRATIC 0
#endif
#ifndef GROUP
#define GROUP 4  // most contact points that one thread takes
#endif
#ifndef ADMM_THREADS
#define ADMM_THREADS 256
#endif
#ifndef ADMM_BLOCKS
#define ADMM_BLOCKS 1
#endif
#ifndef INTERIOR_THREADS
#define INTERIOR_THREADS 256
#endif
#ifndef INTERIOR_BLOCKS
#define INTERIOR_BLOCKS 1
#endif

#ifdef __CUDACC__
#define ON_CHIP_GROUPS THREADS
#else
#define ON_CHIP_GROUPS 1
#endif

constexpr int kRays = QUADRATIC ? 3 : 8;  // multipliers a contact point
constexpr int kStable = 1, kUnstable = -1, kUndecided = 0;
constexpr double kMargin = 1e-3;  // both tests ask for this much more, so that rounding cannot overturn them
constexpr double kBackOff = 0.99;
constexpr double kHuge = 1e300;
constexpr uint16_t kNone = 0xffff;

// Arrays of one structure; positions are parts in elimination order, groups are runs of contact points of a pair.
struct Structure {
  int parts, positions, groups, blocks, levels, points;
  const int* position;       // (parts,) -1 for boundary
  const int* level_start;    // (levels + 1,) first position of each level
  const int* column;         // (positions + 1,) first block of each column
  const int* block_row;      // (blocks,) position of a block's row
  const int* block_column;   // (blocks,) position of a block's column
  const int* fill_start;     // (blocks + 1,)
  const int* fill_left;      // pairs of blocks that fill a block where both are there
  const int* fill_right;
  const int* group_part;     // (2, groups)
  const int* group_first;    // (groups,) first contact point
  const int* group_count;    // (groups,)
  const int* incident_start; // (positions + 1,)
  const int* incident;       // 2 group + side
  const int* block_start;    // (blocks + 1,)
  const int* block_group;    // groups between the two parts of a block
  const float* point_single; // (GROUP, 3, groups, 4): scaled axes by rows, then arm from the pair's middle
  const double* point;       // (GROUP, 13, groups): the same, then the force scale
  const float* arm_single;   // (6, groups): from the centres of parts a and b to the pair's middle
  const double* arm;
  const float* local_single; // (21, groups): lower triangle of the group's share of G G^T about the middle
  const double* mass;        // (positions,)
  const double* inertia;     // (9, positions)
  const double* flexibility; // (9, positions) inverse inertia
  const double* gravity;     // (6, positions)
  double weight, friction;
};

struct Options {
  double rho, relaxation, tolerance, force_bound;
  int iterations, first_check, check_every, interior_steps;
};

// One launch. `list` names the states to take (all where it is null); `*_count` live on the device.
struct Batch {
  const uint8_t* states;   // (batch, parts)
  const double* guess;     // (batch, points, 3) N, or null
  int8_t* verdict;
  double* residual;
  int* iterations;
  double* forces;          // (batch, points, 3) N, or null
  double* velocity;        // (batch, parts, 6), or null
  float* handoff;          // (batch, points, 3) scaled forces, from ADMM to the interior point method
  const int* list;
  const int* list_count;
  int* ticket;
  int* large;              // states that need more memory than this launch has
  int* large_count;
  int* open;               // states that ADMM leaves undecided
  int* open_count;
  char* scratch;           // `scratch_stride` bytes a block, where the pool is not in shared memory
  long long scratch_stride;
  char* points_scratch;    // `points_stride` bytes a block: what the interior point method keeps of each group
  long long points_stride;
  long long pool_bytes;
  int count;
};

// ---------------------------------------------------------------------------------------------------------------
// Reductions over a block. The order of summation depends on the number of threads alone.

template <int Largest, int Sums>
DEVICE void reduce(double (&value)[Largest + Sums]) {
#ifdef __CUDACC__
  constexpr int count = Largest + Sums;
  __shared__ double partial[32 * count];
#pragma unroll
  for (int step = 16; step; step >>= 1)
#pragma unroll
    for (int i = 0; i < count; i++) {
      double other = __shfl_xor_sync(0xffffffffu, value[i], step);
      value[i] = i < Largest ? fmax(value[i], other) : value[i] + other;
    }
  int warps = THREADS >> 5;
  if (warps == 1) return;
  SYNC;
  if ((TID & 31) == 0)
#pragma unroll
    for (int i = 0; i < count; i++) partial[(TID >> 5) * count + i] = value[i];
  SYNC;
#pragma unroll
  for (int i = 0; i < count; i++) value[i] = partial[i];
  for (int w = 1; w < warps; w++)
#pragma unroll
    for (int i = 0; i < count; i++) {
      double other = partial[w * count + i];
      value[i] = i < Largest ? fmax(value[i], other) : value[i] + other;
    }
#else
  (void)value;
#endif
}

DEVICE double finite_or_huge(double x) { return x < kHuge ? x : kHuge; }  // also for NaN

// ---------------------------------------------------------------------------------------------------------------
// Friction cone.

template <class T>
struct Cone {
  T mu, facet, facet_scale, edge, edge_scale;
  DEVICE Cone make(double friction) {
    double k = friction * 0.92387953251128674;
    return {T(friction), T(k), T(1 / (1 + k * k)), T(friction * 0.38268343236508977), T(1 / (1 + friction * friction))};
  }
};

template <class T>
DEVICE void project(const Cone<T>& cone, T& n, T& x, T& y) {
#if QUADRATIC
  T t = sqrt(x * x + y * y);
  if (t <= cone.mu * n) return;
  T s = (n + cone.mu * t) * cone.edge_scale;
  if (!(s > T(0))) {
    n = x = y = T(0);
    return;
  }
  T f = cone.mu * s / t;
  n = s, x *= f, y *= f;
#else
  const T c = T(0.92387953251128674), s = T(0.38268343236508977);
  T ax = fabs(x), ay = fabs(y);
  T u = fmax(ax, ay), v = fmin(ax, ay);
  T p = u * c + v * s, q = v * c - u * s;  // along the normal of the facet, and along the facet
  if (p <= cone.facet * n) return;
  T t = (n + cone.facet * p) * cone.facet_scale;
  T reach = cone.edge * t;
  if (!(t > T(0) && fabs(q) <= reach)) {
    t = (n + cone.facet * p + cone.edge * fabs(q)) * cone.edge_scale;
    t = t <= T(0) ? T(0) : t;  // keeps NaN
    q = copysign(cone.edge * t, q);
  }
  p = cone.facet * t;
  u = p * c - q * s, v = p * s + q * c;
  bool swap = ay > ax;
  n = t;
  x = copysign(swap ? v : u, x);
  y = copysign(swap ? u : v, y);
#endif
}

// Largest power of a force of the cone with normal component 1.
template <class T>
DEVICE T support(T mu, T n, T x, T y) {
#if QUADRATIC
  return n + mu * sqrt(x * x + y * y);
#else
  T ax = fabs(x), ay = fabs(y);
  return n + mu * fmax(fmax(ax, ay), T(0.70710678118654752) * (ax + ay));
#endif
}

DEVICE double ray_x(int k) {
  const double d = 0.70710678118654752;
  return k == 0 ? 1.0 : k == 4 ? -1.0 : (k == 2 || k == 6) ? 0.0 : (k == 1 || k == 7) ? d : -d;
}
DEVICE double ray_y(int k) { return ray_x((k + 6) & 7); }

// ---------------------------------------------------------------------------------------------------------------
// A state on chip.

// There is a block for every node and each of its ancestors in the elimination tree: the pattern of the inverse of
// the factor. The ancestors of a node are a chain, so the block of ancestor `i` in column `j` is number
// `column[j] + depth[j] - depth[i] - 1`. ADMM stores all of them, since it solves often; the interior point method
// stores those that the factor itself has.
struct State {
  int nodes, groups, blocks, levels;  // what acts in this state
  int storage;                        // blocks that are stored
  uint16_t* node;                     // positions that can move
  uint16_t* node_slot;                // (positions,) index in `node`
  uint16_t* level_node;               // first node of each level that is not empty
  uint16_t* group;                    // groups that act
  uint16_t* group_slot;               // (groups,) index in `group`
  uint16_t* group_node;               // (2, groups that act) node of each side, kNone where it is held
  uint16_t* depth;                    // number of ancestors of each node
  int* column;                        // first block of each node's column
  uint16_t* block_row;                // node of each block's row
  uint16_t* block_column;             // node of each block's column
  uint16_t* block_pattern;            // block of the structure's pattern, kNone where the factor is zero
  short* stored;                      // where each block is stored, -1 where it is not; null where all are
  int* row;                           // first entry of each node's row
  int* row_block;                     // blocks of the rows, column by column; -1 - block where the factor is zero
  uint16_t* incident;                 // 2 slot + side of the groups on each node
  uint16_t *incident_first, *incident_last;

  METHOD int at(int block) const { return stored ? stored[block] : block; }

  // Block of row `i` in column `j`, -1 where `i` is no ancestor of `j`.
  METHOD int block_of(int i, int j) const {
    int up = int(depth[j]) - int(depth[i]) - 1;
    if (up < 0) return -1;
    int b = column[j] + up;
    return block_row[b] == i ? b : -1;
  }
};

#ifdef __CUDACC__
template <class T>
struct Pair;
template <>
struct Pair<float> {
  typedef float2 type;
};
template <>
struct Pair<double> {
  typedef double2 type;
};
#endif

template <class T>
DEVICE T* take(char*& top, long long count) {
  T* result = reinterpret_cast<T*>(top);
  top += (count * sizeof(T) + 15) / 16 * 16;
  return result;
}

DEVICE int rank_of(const uint32_t* mask, int i) {
  int rank = POPCOUNT(mask[i >> 5] & ((1u << (i & 31)) - 1u));
  for (int w = 0; w < i >> 5; w++) rank += POPCOUNT(mask[w]);
  return rank;
}

// Turns flags in `slot` (kNone or not) into indices of a list, in order; every thread returns its length.
DEVICE int compact(uint16_t* slot, uint16_t* list, uint32_t* mask, int count) {
  int words = (count + 31) >> 5;
  for (int w = TID; w < words; w += THREADS) {
    uint32_t bits = 0;
    for (int i = w * 32; i < count && i < w * 32 + 32; i++) bits |= uint32_t(slot[i] != kNone) << (i & 31);
    mask[w] = bits;
  }
  SYNC;
  for (int i = TID; i < count; i += THREADS)
    if (slot[i] != kNone) {
      int rank = rank_of(mask, i);
      slot[i] = uint16_t(rank);
      list[rank] = uint16_t(i);
    }
  int total = 0;
  for (int w = 0; w < words; w++) total += POPCOUNT(mask[w]);
  SYNC;
  return total;
}

// Finds what acts in a state, its elimination tree and the blocks of its factor.
template <bool StoreAll>
PHASE State restrict_to(const Structure& s, const uint8_t* state, char*& top) {
  State a;
  int largest = s.positions > s.groups ? s.positions : s.groups;
  uint32_t* mask = take<uint32_t>(top, (largest + 31) / 32);
  uint8_t* filled = take<uint8_t>(top, s.blocks);
  a.node = take<uint16_t>(top, s.positions);
  a.node_slot = take<uint16_t>(top, s.positions);
  a.level_node = take<uint16_t>(top, s.levels + 1);
  a.group = take<uint16_t>(top, s.groups);
  a.group_slot = take<uint16_t>(top, s.groups);

  for (int p = TID; p < s.parts; p += THREADS) {
    int j = load(s.position + p);
    if (j >= 0) a.node_slot[j] = state[p] == 1 ? 0 : kNone;
  }
  for (int g = TID; g < s.groups; g += THREADS) {
    int pa = state[load(s.group_part + g)], pb = state[load(s.group_part + s.groups + g)];
    a.group_slot[g] = pa && pb && (pa == 1 || pb == 1) ? 0 : kNone;
  }
  SYNC;
  // A block is in the pattern of S where its two parts touch and both can move; two such parts always act.
  for (int e = TID; e < s.blocks; e += THREADS) {
    bool both = a.node_slot[load(s.block_row + e)] != kNone && a.node_slot[load(s.block_column + e)] != kNone;
    filled[e] = both && load(s.block_start + e) < load(s.block_start + e + 1);
  }
  a.nodes = compact(a.node_slot, a.node, mask, s.positions);
  a.groups = compact(a.group_slot, a.group, mask, s.groups);
  for (int level = 1; level < s.levels; level++) {  // fill
    int last = load(s.column + load(s.level_start + level + 1));
    for (int e = load(s.column + load(s.level_start + level)) + TID; e < last; e += THREADS) {
      if (filled[e] || a.node_slot[load(s.block_column + e)] == kNone) continue;
      for (int u = load(s.fill_start + e); u < load(s.fill_start + e + 1); u++)
        if (filled[load(s.fill_left + u)] && filled[load(s.fill_right + u)]) {
          filled[e] = 1;
          break;
        }
    }
    SYNC;
  }
  a.group_node = take<uint16_t>(top, 2 * a.groups);
  a.depth = take<uint16_t>(top, a.nodes);
  a.column = take<int>(top, a.nodes + 1);
  a.row = take<int>(top, a.nodes + 1);
  a.incident = take<uint16_t>(top, 2 * s.groups);
  a.incident_first = take<uint16_t>(top, a.nodes);
  a.incident_last = take<uint16_t>(top, a.nodes);
  uint16_t* parent = take<uint16_t>(top, a.nodes);
  for (int i = TID; i < a.groups; i += THREADS)
    for (int side = 0; side < 2; side++) {
      int j = load(s.position + load(s.group_part + side * s.groups + a.group[i]));
      a.group_node[side * a.groups + i] = j >= 0 ? a.node_slot[j] : kNone;
    }
  for (int i = TID; i < a.nodes; i += THREADS) {
    int j = a.node[i], e = load(s.column + j), last = load(s.column + j + 1);
    while (e < last && !filled[e]) e++;
    parent[i] = e < last ? a.node_slot[load(s.block_row + e)] : kNone;
    // Groups of the whole structure with those that do not act left out; each list keeps its place.
    int k = load(s.incident_start + j), out = k, end = load(s.incident_start + j + 1);
    a.incident_first[i] = uint16_t(k);
    for (; k < end; k++) {
      int code = load(s.incident + k), slot = a.group_slot[code >> 1];
      if (slot != kNone) a.incident[out++] = uint16_t(2 * slot + (code & 1));
    }
    a.incident_last[i] = uint16_t(out);
  }
  a.levels = 0;
  for (int level = 0, i = 0; level < s.levels; level++) {  // every thread alike
    int first = i, last = load(s.level_start + level + 1);
    while (i < a.nodes && a.node[i] < last) i++;
    if (i == first) continue;
    if (TID == 0) a.level_node[a.levels] = uint16_t(first);
    a.levels++;
  }
  if (TID == 0) a.level_node[a.levels] = uint16_t(a.nodes);
  SYNC;
  for (int i = TID; i < a.nodes; i += THREADS) {
    int depth = 0;
    for (int k = parent[i]; k != kNone; k = parent[k]) depth++;
    a.depth[i] = uint16_t(depth);
  }
  SYNC;
  for (int i = TID; i <= a.nodes; i += THREADS) {
    int total = 0;
    for (int k = 0; k < i; k++) total += a.depth[k];
    a.column[i] = total;
  }
  SYNC;
  a.blocks = a.column[a.nodes];
  a.block_row = take<uint16_t>(top, a.blocks);
  a.block_column = take<uint16_t>(top, a.blocks);
  a.block_pattern = take<uint16_t>(top, a.blocks);
  a.row_block = take<int>(top, a.blocks);
  for (int i = TID; i < a.nodes; i += THREADS) {
    int b = a.column[i], j = a.node[i], e = load(s.column + j), last = load(s.column + j + 1);
    for (int k = parent[i]; k != kNone; k = parent[k], b++) {
      int row = a.node[k];
      while (e < last && load(s.block_row + e) < row) e++;
      a.block_row[b] = uint16_t(k);
      a.block_column[b] = uint16_t(i);
      a.block_pattern[b] = e < last && load(s.block_row + e) == row && filled[e] ? uint16_t(e) : kNone;
    }
  }
  SYNC;
  uint16_t* count = parent;
  a.stored = nullptr;
  a.storage = a.blocks;
  if (!StoreAll) {
    a.stored = take<short>(top, a.blocks);
    for (int i = TID; i < a.nodes; i += THREADS) {
      int total = 0;
      for (int b = a.column[i]; b < a.column[i + 1]; b++) total += a.block_pattern[b] != kNone;
      count[i] = uint16_t(total);
    }
    SYNC;
    for (int i = TID; i < a.nodes; i += THREADS) {
      int out = 0;
      for (int k = 0; k < i; k++) out += count[k];
      for (int b = a.column[i]; b < a.column[i + 1]; b++) a.stored[b] = short(a.block_pattern[b] == kNone ? -1 : out++);
    }
    a.storage = 0;
    for (int k = 0; k < a.nodes; k++) a.storage += count[k];
    SYNC;
  }
  for (int i = TID; i < a.nodes; i += THREADS) {
    int total = 0;
    for (int j = 0; j < i; j++) total += a.block_of(i, j) >= 0;
    count[i] = uint16_t(total);
  }
  SYNC;
  for (int i = TID; i <= a.nodes; i += THREADS) {
    int out = 0;
    for (int k = 0; k < i; k++) out += count[k];
    a.row[i] = out;
    for (int j = 0; j < i && i < a.nodes; j++) {
      int b = a.block_of(i, j);
      if (b >= 0) a.row_block[out++] = a.block_pattern[b] == kNone ? -1 - b : b;
    }
  }
  SYNC;
  return a;
}

// ---------------------------------------------------------------------------------------------------------------
// Contact points and pairs.

DEVICE float arm_of(const Structure& s, int i, int g, float) { return load(s.arm_single + i * s.groups + g); }
DEVICE double arm_of(const Structure& s, int i, int g, double) { return load(s.arm + i * s.groups + g); }

template <class T>
struct Point {
  T axis[9], arm[3];  // axes by columns: n, t1, t2
};

DEVICE Point<float> point_of(const Structure& s, int i, int g, float) {
  Point<float> p;
  float* out = p.axis;
#pragma unroll
  for (int k = 0; k < 3; k++) {
#ifdef __CUDACC__
    float4 f = __ldg(reinterpret_cast<const float4*>(s.point_single) + (i * 3 + k) * s.groups + g);
    float v[4] = {f.x, f.y, f.z, f.w};
#else
    const float* v = s.point_single + ((i * 3 + k) * s.groups + g) * 4;
#endif
#pragma unroll
    for (int c = 0; c < 4; c++) (k * 4 + c < 9 ? out[k * 4 + c] : p.arm[k * 4 + c - 9]) = v[c];
  }
  return p;
}
DEVICE Point<double> point_of(const Structure& s, int i, int g, double) {
  Point<double> p;
#pragma unroll
  for (int k = 0; k < 9; k++) p.axis[k] = load(s.point + (i * 13 + k) * s.groups + g);
#pragma unroll
  for (int k = 0; k < 3; k++) p.arm[k] = load(s.point + (i * 13 + 9 + k) * s.groups + g);
  return p;
}
DEVICE double scale_of(const Structure& s, int i, int g) { return load(s.point + (i * 13 + 12) * s.groups + g); }

// Relative velocity and rotation of part b against part a at the middle between them.
template <class T, class V>
DEVICE void strain_of(const int (&node)[2], const T (&arm)[6], const V* velocity, T (&out)[6]) {
#pragma unroll
  for (int k = 0; k < 6; k++) out[k] = T(0);
#pragma unroll
  for (int side = 0; side < 2; side++) {
    if (node[side] == kNone) continue;
    T sign = side ? T(1) : T(-1);
    const V* v = velocity + node[side] * 6;
    T x = arm[side * 3], y = arm[side * 3 + 1], z = arm[side * 3 + 2];
    T wx = sign * T(v[3]), wy = sign * T(v[4]), wz = sign * T(v[5]);
    out[0] += sign * T(v[0]) + wy * z - wz * y;
    out[1] += sign * T(v[1]) + wz * x - wx * z;
    out[2] += sign * T(v[2]) + wx * y - wy * x;
    out[3] += wx, out[4] += wy, out[5] += wz;
  }
}

template <class T, class V>
DEVICE void group_strain(const Structure& s, const State& a, int slot, int g, const V* velocity, T (&out)[6]) {
  int node[2] = {a.group_node[slot], a.group_node[a.groups + slot]};
  T arm[6];
#pragma unroll
  for (int k = 0; k < 6; k++) arm[k] = arm_of(s, k, g, T(0));
  strain_of(node, arm, velocity, out);
}

template <class T>
DEVICE void point_strain(const Point<T>& p, const T (&strain)[6], T& n, T& x, T& y) {
  T vx = strain[0] + strain[4] * p.arm[2] - strain[5] * p.arm[1];
  T vy = strain[1] + strain[5] * p.arm[0] - strain[3] * p.arm[2];
  T vz = strain[2] + strain[3] * p.arm[1] - strain[4] * p.arm[0];
  n = p.axis[0] * vx + p.axis[3] * vy + p.axis[6] * vz;
  x = p.axis[1] * vx + p.axis[4] * vy + p.axis[7] * vz;
  y = p.axis[2] * vx + p.axis[5] * vy + p.axis[8] * vz;
}

template <class T>
DEVICE void add_point_force(const Point<T>& p, T n, T x, T y, T (&wrench)[6]) {
  T fx = p.axis[0] * n + p.axis[1] * x + p.axis[2] * y;
  T fy = p.axis[3] * n + p.axis[4] * x + p.axis[5] * y;
  T fz = p.axis[6] * n + p.axis[7] * x + p.axis[8] * y;
  wrench[0] += fx, wrench[1] += fy, wrench[2] += fz;
  wrench[3] += p.arm[1] * fz - p.arm[2] * fy;
  wrench[4] += p.arm[2] * fx - p.arm[0] * fz;
  wrench[5] += p.arm[0] * fy - p.arm[1] * fx;
}

// Writes a force and moment about the middle of group `slot` as wrenches about the centres of its parts that move.
template <class T>
DEVICE void write_wrench(const State& a, int slot, const int (&node)[2], const T (&arm)[6], const T (&f)[6], T* wrench) {
#pragma unroll
  for (int side = 0; side < 2; side++) {
    if (node[side] == kNone) continue;
    T sign = side ? T(1) : T(-1);
    const T* d = arm + side * 3;
    T* out = wrench + side * 6 * a.groups + slot;
    out[0] = sign * f[0], out[a.groups] = sign * f[1], out[2 * a.groups] = sign * f[2];
    out[3 * a.groups] = sign * (f[3] + d[1] * f[2] - d[2] * f[1]);
    out[4 * a.groups] = sign * (f[4] + d[2] * f[0] - d[0] * f[2]);
    out[5 * a.groups] = sign * (f[5] + d[0] * f[1] - d[1] * f[0]);
  }
}

template <class T>
DEVICE void write_group_wrench(const Structure& s, const State& a, int slot, int g, const T (&f)[6], T* wrench) {
  int node[2] = {a.group_node[slot], a.group_node[a.groups + slot]};
  T arm[6];
#pragma unroll
  for (int k = 0; k < 6; k++) arm[k] = arm_of(s, k, g, T(0));
  write_wrench(a, slot, node, arm, f, wrench);
}

// Component `r` of gravity and of all group wrenches on a node.
template <class T>
DEVICE T node_wrench(const Structure& s, const State& a, int node, int r, const T* wrench) {
  T total = T(load(s.gravity + r * s.positions + a.node[node]));
  int last = a.incident_last[node];
#pragma unroll 4
  for (int k = a.incident_first[node]; k < last; k++) {
    int code = a.incident[k];
    total += wrench[((code & 1) * 6 + r) * a.groups + (code >> 1)];
  }
  return total;
}

// ---------------------------------------------------------------------------------------------------------------
// S = shift M + sum of the groups' local matrices, and solves with it. All by 6 x 6 blocks, row by row.

template <class T>
struct Matrix {
  T* diagonal;  // (nodes, 36): S, then the inverse of the factor
  T* lower;     // (storage, 36)
};

// Where entry (i, k) of a symmetric matrix stands in its packed lower triangle.
DEVICE int packed(int i, int k) { return i >= k ? i * (i + 1) / 2 + k : k * (k + 1) / 2 + i; }

DEVICE float local_of(const Structure& s, const State&, const float* local, int i, int g, int) {
  return load(local + i * s.groups + g);
}
DEVICE double local_of(const Structure&, const State& a, const double* local, int i, int, int slot) {
  return local[i * a.groups + slot];
}

// Row `r` of T_left local T_right^T, added to `out` with a sign.
template <class T>
DEVICE void add_local_row(
    const Structure& s, const State& a, const T* local, int g, int slot, int r, int left, int right, T sign,
    T (&out)[6]) {
  T v[6];
  if (r < 3) {
#pragma unroll
    for (int k = 0; k < 6; k++) v[k] = sign * local_of(s, a, local, packed(r, k), g, slot);
  } else {
    int q = r - 3, q1 = q == 2 ? 0 : q + 1, q2 = q == 0 ? 2 : q - 1;
    T a1 = arm_of(s, left * 3 + q1, g, T(0)), a2 = arm_of(s, left * 3 + q2, g, T(0));
#pragma unroll
    for (int k = 0; k < 6; k++)
      v[k] = sign * (local_of(s, a, local, packed(r, k), g, slot) + a1 * local_of(s, a, local, packed(q2, k), g, slot) -
                     a2 * local_of(s, a, local, packed(q1, k), g, slot));
  }
  T x = arm_of(s, right * 3, g, T(0)), y = arm_of(s, right * 3 + 1, g, T(0)), z = arm_of(s, right * 3 + 2, g, T(0));
  out[0] += v[0], out[1] += v[1], out[2] += v[2];
  out[3] += v[3] + y * v[2] - z * v[1];
  out[4] += v[4] + z * v[0] - x * v[2];
  out[5] += v[5] + x * v[1] - y * v[0];
}

template <class T>
PHASE void assemble(const Structure& s, const State& a, double shift, const T* local, Matrix<T> m) {
  for (int t = TID; t < (a.nodes + a.blocks) * 6; t += THREADS) {
    int item = t / 6, r = t % 6;
    int place = item < a.nodes ? item : a.at(item - a.nodes);
    if (place < 0) continue;
    T out[6] = {};
    if (item < a.nodes) {
      int j = a.node[item];
      if (r < 3) {
#pragma unroll
        for (int k = 0; k < 3; k++) out[k] = r == k ? T(shift * load(s.mass + j)) : T(0);
      } else {
#pragma unroll
        for (int k = 0; k < 3; k++) out[3 + k] = T(shift * load(s.inertia + ((r - 3) * 3 + k) * s.positions + j));
      }
      for (int k = a.incident_first[item]; k < a.incident_last[item]; k++) {
        int code = a.incident[k], slot = code >> 1;
        add_local_row(s, a, local, int(a.group[slot]), slot, r, code & 1, code & 1, T(1), out);
      }
    } else {
      int e = a.block_pattern[item - a.nodes];
      int k = e == kNone ? 0 : load(s.block_start + e), last = e == kNone ? 0 : load(s.block_start + e + 1);
      for (; k < last; k++) {
        int g = load(s.block_group + k);
        int side = load(s.position + load(s.group_part + s.groups + g)) == load(s.block_row + e);
        add_local_row(s, a, local, g, int(a.group_slot[g]), r, side, 1 - side, T(-1), out);
      }
    }
    T* row = (item < a.nodes ? m.diagonal : m.lower) + place * 36 + r * 6;
#pragma unroll
    for (int k = 0; k < 6; k++) row[k] = out[k];
  }
  SYNC;
}

// Replaces a 6 x 6 block by the inverse of its Cholesky factor (lower triangle); false where a pivot is not positive.
template <class T>
DEVICE bool invert_factor(T* block) {
  T c[21];
#pragma unroll
  for (int i = 0; i < 6; i++)
#pragma unroll
    for (int j = 0; j <= i; j++) c[i * (i + 1) / 2 + j] = block[i * 6 + j];
  bool good = true;
#pragma unroll
  for (int j = 0; j < 6; j++) {
    T pivot = c[j * (j + 1) / 2 + j];
    good = good && pivot > T(0);
#ifdef __CUDACC__
    T inverse = rsqrt(pivot);
#else
    T inverse = T(1) / sqrt(pivot);
#endif
    c[j * (j + 1) / 2 + j] = inverse;  // the diagonal holds 1 / C_jj
#pragma unroll
    for (int i = j + 1; i < 6; i++) c[i * (i + 1) / 2 + j] *= inverse;
#pragma unroll
    for (int i = j + 1; i < 6; i++)
#pragma unroll
      for (int k = j + 1; k <= i; k++) c[i * (i + 1) / 2 + k] -= c[i * (i + 1) / 2 + j] * c[k * (k + 1) / 2 + j];
  }
#pragma unroll
  for (int j = 0; j < 6; j++)
#pragma unroll
    for (int i = j + 1; i < 6; i++) {
      T total = T(0);
#pragma unroll
      for (int k = j; k < i; k++) total += c[i * (i + 1) / 2 + k] * c[k * (k + 1) / 2 + j];
      c[i * (i + 1) / 2 + j] = -total * c[i * (i + 1) / 2 + i];
    }
#pragma unroll
  for (int i = 0; i < 6; i++)
#pragma unroll
    for (int j = 0; j <= i; j++) block[i * 6 + j] = c[i * (i + 1) / 2 + j];
  return good;
}

template <class T>
DEVICE T dot6(const T* a, const T* b) {
#ifdef __CUDACC__
  using Two = typename Pair<T>::type;  // rows are 24 or 48 bytes
  const Two* p = reinterpret_cast<const Two*>(a);
  const Two* q = reinterpret_cast<const Two*>(b);
  Two a0 = p[0], a1 = p[1], a2 = p[2], b0 = q[0], b1 = q[1], b2 = q[2];
  return (a0.x * b0.x + a0.y * b0.y) + (a1.x * b1.x + a1.y * b1.y) + (a2.x * b2.x + a2.y * b2.y);
#else
  return (a[0] * b[0] + a[1] * b[1]) + (a[2] * b[2] + a[3] * b[3]) + (a[4] * b[4] + a[5] * b[5]);
#endif
}

// Replaces S, level by level, by its Cholesky factor C with inverted diagonal blocks; false where a pivot is not
// positive. Then multiplies by them to make L with unit diagonal.
template <class T>
PHASE bool factor(const State& a, Matrix<T> m) {
  double bad[1] = {0};
  for (int level = 0; level < a.levels; level++) {
    int node0 = a.level_node[level], nodes = a.level_node[level + 1] - node0;
    int block0 = a.column[node0], blocks = a.column[node0 + nodes] - block0;
    for (int t = TID; level && t < (nodes + blocks) * 6; t += THREADS) {
      int item = t / 6, r = t - item * 6, b = block0 + item - nodes;
      if (item >= nodes && a.block_pattern[b] == kNone) continue;
      int j = item < nodes ? node0 + item : a.block_column[b];
      int up = item < nodes ? 0 : a.depth[j] - a.depth[a.block_row[b]];
      T* row = (item < nodes ? m.diagonal + j * 36 : m.lower + a.at(b) * 36) + r * 6;
      T out[6];
#pragma unroll
      for (int k = 0; k < 6; k++) out[k] = row[k];
      for (int n = a.row[j]; n < a.row[j + 1]; n++) {
        int right = a.row_block[n];
        if (right < 0) continue;
        int left = a.at(right + up);
        if (left < 0) continue;
        const T* x = m.lower + left * 36 + r * 6;
        const T* y = m.lower + a.at(right) * 36;
#pragma unroll
        for (int k = 0; k < 6; k++) out[k] -= dot6(x, y + k * 6);
      }
#pragma unroll
      for (int k = 0; k < 6; k++) row[k] = out[k];
    }
    SYNC;
    for (int i = TID; i < nodes; i += THREADS)
      if (!invert_factor(m.diagonal + (node0 + i) * 36)) bad[0] = 1;
    SYNC;
    for (int t = TID; t < blocks * 6; t += THREADS) {
      int b = block0 + t / 6;
      if (a.block_pattern[b] == kNone) continue;
      T* row = m.lower + a.at(b) * 36 + t % 6 * 6;
      const T* c = m.diagonal + a.block_column[b] * 36;
      T x[6];
#pragma unroll
      for (int k = 0; k < 6; k++) x[k] = row[k];
#pragma unroll
      for (int k = 0; k < 6; k++) {
        T total = T(0);
#pragma unroll
        for (int i = 0; i <= k; i++) total += x[i] * c[k * 6 + i];
        row[k] = total;
      }
    }
    SYNC;
  }
  for (int t = TID; t < a.blocks * 6; t += THREADS) {
    int b = t / 6;
    if (a.block_pattern[b] == kNone) continue;
    T* row = m.lower + a.at(b) * 36 + t % 6 * 6;
    const T* c = m.diagonal + a.block_column[b] * 36;
    T x[6];
#pragma unroll
    for (int k = 0; k < 6; k++) x[k] = row[k];
#pragma unroll
    for (int i = 0; i < 6; i++) {
      T total = T(0);
#pragma unroll
      for (int k = i; k < 6; k++) total += x[k] * c[k * 6 + i];
      row[i] = total;
    }
  }
  SYNC;
  reduce<1, 0>(bad);
  SYNC;
  return bad[0] == 0;
}

// From L and the inverse of the diagonal of C to W = L^-1 and then to V = C^-1, so that S^-1 = V^T V.
template <class T>
PHASE void invert(const State& a, Matrix<T> m) {
  // Row i of W in place of row i of L: a block of L is needed for the columns up to its own, so columns ascend and
  // nothing is written before all threads have read.
  for (int level = 1; level < a.levels; level++) {
    int first = a.row[a.level_node[level]], items = (a.row[a.level_node[level + 1]] - first) * 6;
    for (int t0 = 0; t0 < items; t0 += THREADS) {
      int t = t0 + TID;
      T out[6];
      T* row = nullptr;
      if (t < items) {
        int b = a.row_block[first + t / 6], r = t % 6;
        b = b < 0 ? -1 - b : b;
        row = m.lower + b * 36 + r * 6;
        int j = a.block_column[b], depth = a.depth[a.block_row[b]];
#pragma unroll
        for (int k = 0; k < 6; k++) out[k] = -row[k];
        for (int c = a.column[j]; c < b; c++) {
          int k = a.block_row[c], left = a.column[k] + a.depth[k] - depth - 1;
          if (a.block_pattern[left] == kNone) continue;
          const T* x = m.lower + left * 36 + r * 6;
          const T* y = m.lower + c * 36;
#pragma unroll
          for (int i = 0; i < 6; i++) {
            T value = x[i];
#pragma unroll
            for (int n = 0; n < 6; n++) out[n] -= value * y[i * 6 + n];
          }
        }
      }
      SYNC;
      if (row)
#pragma unroll
        for (int k = 0; k < 6; k++) row[k] = out[k];
    }
    SYNC;
  }
  for (int t = TID; t < a.blocks * 6; t += THREADS) {
    int b = t / 6;
    T* column = m.lower + b * 36 + t % 6;
    const T* c = m.diagonal + a.block_row[b] * 36;
    T x[6];
#pragma unroll
    for (int k = 0; k < 6; k++) x[k] = column[k * 6];
#pragma unroll
    for (int i = 0; i < 6; i++) {
      T total = T(0);
#pragma unroll
      for (int k = 0; k <= i; k++) total += c[i * 6 + k] * x[k];
      column[i * 6] = total;
    }
  }
  for (int t = TID; t < a.nodes * 36; t += THREADS)
    if (t / 6 % 6 < t % 6) m.diagonal[t] = T(0);
  SYNC;
}

// Solves S out = V^T V x; `between` holds V x.
template <class T>
DEVICE void solve(const State& a, Matrix<T> m, const T* x, T* between, T* out) {
  for (int t = TID; t < a.nodes * 6; t += THREADS) {
    int i = t / 6, r = t - i * 6, end = a.row[i + 1];
    T total = dot6(m.diagonal + t * 6, x + i * 6);
#pragma unroll 4
    for (int k = a.row[i]; k < end; k++) {
      int b = a.row_block[k];
      b = b < 0 ? -1 - b : b;
      total += dot6(m.lower + b * 36 + r * 6, x + a.block_column[b] * 6);
    }
    between[t] = total;
  }
  SYNC;
  for (int t = TID; t < a.nodes * 6; t += THREADS) {
    int j = t / 6, c = t - j * 6, end = a.column[j + 1];
    const T* l = m.diagonal + j * 36 + c;
    const T* y = between + j * 6;
    T total = (l[0] * y[0] + l[6] * y[1]) + (l[12] * y[2] + l[18] * y[3]) + (l[24] * y[4] + l[30] * y[5]);
#pragma unroll 4
    for (int b = a.column[j]; b < end; b++) {
      l = m.lower + b * 36 + c;
      y = between + a.block_row[b] * 6;
      total += (l[0] * y[0] + l[6] * y[1]) + (l[12] * y[2] + l[18] * y[3]) + (l[24] * y[4] + l[30] * y[5]);
    }
    out[t] = total;
  }
  SYNC;
}

// Solves S out = x with L and the inverse of the diagonal of C, level by level; overwrites x.
template <class T>
DEVICE void solve_by_levels(const State& a, Matrix<T> m, T* x, T* between, T* out) {
  for (int level = 1; level < a.levels; level++) {
    int last = a.level_node[level + 1] * 6;
    for (int t = a.level_node[level] * 6 + TID; t < last; t += THREADS) {
      int i = t / 6, r = t - i * 6, end = a.row[i + 1];
      T total = x[t];
      for (int k = a.row[i]; k < end; k++) {
        int b = a.row_block[k];
        if (b >= 0) total -= dot6(m.lower + a.at(b) * 36 + r * 6, x + a.block_column[b] * 6);
      }
      x[t] = total;
    }
    SYNC;
  }
  for (int t = TID; t < a.nodes * 6; t += THREADS) {
    int i = t / 6, r = t - i * 6;
    T total = T(0);
    for (int k = 0; k <= r; k++) total += m.diagonal[t * 6 + k] * x[i * 6 + k];
    between[t] = total;
  }
  SYNC;
  for (int level = a.levels - 1; level >= 0; level--) {
    int last = a.level_node[level + 1] * 6;
    for (int t = a.level_node[level] * 6 + TID; t < last; t += THREADS) {
      int j = t / 6, c = t - j * 6, end = a.column[j + 1];
      T total = T(0);
      for (int k = c; k < 6; k++) total += m.diagonal[j * 36 + k * 6 + c] * between[j * 6 + k];
      for (int b = a.column[j]; b < end; b++) {
        int place = a.at(b);
        if (place < 0) continue;
        const T* l = m.lower + place * 36 + c;
        const T* y = out + a.block_row[b] * 6;
        total -= (l[0] * y[0] + l[6] * y[1]) + (l[12] * y[2] + l[18] * y[3]) + (l[24] * y[4] + l[30] * y[5]);
      }
      out[t] = total;
    }
    SYNC;
  }
}

// ---------------------------------------------------------------------------------------------------------------
// The two tests, in float64 whatever made the numbers.

// Where the forces of a contact point come from.
struct FromIterate {  // ADMM: the projection of u in float64, so that they lie in the cone to the last bit
  const float* u;
  int slot_stride, stride;
  Cone<double> cone;
  DEVICE void force(const FromIterate& f, const State&, int i, int slot, double& n, double& x, double& y) {
    const float* u = f.u + slot * f.slot_stride + i * 3 * f.stride;
    n = u[0], x = u[f.stride], y = u[2 * f.stride];
    project(f.cone, n, x, y);
  }
};
struct FromMultipliers {
  const double* weights;
  double mu;
  DEVICE void force(const FromMultipliers& f, const State& a, int i, int slot, double& n, double& x, double& y) {
    const double* w = f.weights + (i * kRays) * a.groups + slot;
#if QUADRATIC
    n = w[0] / f.mu, x = w[a.groups], y = w[2 * a.groups];
#else
    n = x = y = 0;
#pragma unroll
    for (int k = 0; k < 8; k++) {
      double v = w[k * a.groups];
      n += v, x += f.mu * ray_x(k) * v, y += f.mu * ray_y(k) * v;
    }
#endif
  }
};

// What the two tests need to know of a block's share of the state.
struct Tally {
  double v[5];  // largest acceleration, largest power taken a newton; power of gravity, momentum, sum of normals
};

template <class T, class V>
DEVICE void tally_nodes(const Structure& s, const State& a, const T* wrench, const V* velocity, Tally& tally) {
  for (int t = TID; t < a.nodes * 2; t += THREADS) {
    int node = t >> 1, j = a.node[node], half = t & 1;
    const V* v = velocity + node * 6 + half * 3;
    double f[3];
#pragma unroll
    for (int r = 0; r < 3; r++) {
      f[r] = node_wrench(s, a, node, half * 3 + r, wrench);
      tally.v[2] += double(v[r]) * load(s.gravity + (half * 3 + r) * s.positions + j);
    }
    double mass = load(s.mass + j);
#pragma unroll
    for (int r = 0; r < 3; r++) {
      double acceleration = f[r] / mass, momentum = mass * double(v[r]);
      if (half) {
        acceleration = momentum = 0;
#pragma unroll
        for (int c = 0; c < 3; c++) {
          acceleration += load(s.flexibility + (r * 3 + c) * s.positions + j) * f[c];
          momentum += load(s.inertia + (r * 3 + c) * s.positions + j) * double(v[c]);
        }
      }
      tally.v[0] = fmax(tally.v[0], finite_or_huge(fabs(acceleration)));
      tally.v[3] += fabs(momentum);
    }
  }
  reduce<2, 3>(tally.v);
}

// Verdict from the totals. `slack` loosens both tests: with 1 % of it they only say whether a proof is near.
DEVICE int decide(const Structure& s, const Options& o, const Tally& tally, double slack, double& residual) {
  double bound = o.force_bound * s.weight;
  residual = tally.v[4] <= bound * (1 + slack) ? tally.v[0] : kHuge;
  if (residual < (1 - kMargin + slack) * o.tolerance) return kStable;
  double worst = fmax(tally.v[1], 0.0) * (1 - slack);
  double least = (tally.v[2] - worst * bound) / tally.v[3];
  if (!(tally.v[3] > 0 && least > (1 + kMargin - slack) * o.tolerance && least < kHuge)) return kUndecided;
  residual = least;
  return kUnstable;
}

template <class V, class Source>
PHASE int judge(
    const Structure& s, const State& a, const Options& o, Source source, const V* velocity, double* wrench,
    double& residual) {
  Tally tally = {{0, -kHuge, 0, 0, 0}};
  for (int slot = TID; slot < a.groups; slot += THREADS) {
    int g = a.group[slot], count = load(s.group_count + g);
    double strain[6], sum[6] = {};
    group_strain(s, a, slot, g, velocity, strain);
    for (int i = 0; i < count; i++) {
      Point<double> p = point_of(s, i, g, 0.0);
      double scale = scale_of(s, i, g), n, x, y;
      point_strain(p, strain, n, x, y);
      tally.v[1] = fmax(tally.v[1], finite_or_huge(support(s.friction, -n, -x, -y) / scale));
      Source::force(source, a, i, slot, n, x, y);
      tally.v[4] += n * scale;
      add_point_force(p, n, x, y, sum);
    }
    write_group_wrench(s, a, slot, g, sum, wrench);
  }
  SYNC;
  tally_nodes(s, a, wrench, velocity, tally);
  SYNC;
  return decide(s, o, tally, 0.0, residual);
}

template <class V, class Source>
PHASE void write_result(
    const Structure& s, const State& a, const Batch& b, int index, int verdict, double residual, int iterations,
    Source source, const V* velocity) {
  if (TID == 0) {
    b.verdict[index] = int8_t(verdict);
    b.residual[index] = residual;
    b.iterations[index] = iterations;
  }
  if (b.forces) {
    double* forces = b.forces + (long long)index * s.points * 3;
    for (int g = TID; g < s.groups; g += THREADS)
      if (a.group_slot[g] == kNone)
        for (int i = 0; i < load(s.group_count + g) * 3; i++) forces[load(s.group_first + g) * 3 + i] = 0;
    for (int slot = TID; slot < a.groups; slot += THREADS) {
      int g = a.group[slot];
      double* out = forces + load(s.group_first + g) * 3;
      for (int i = 0; i < load(s.group_count + g); i++) {
        double n, x, y, scale = scale_of(s, i, g);
        Source::force(source, a, i, slot, n, x, y);
        out[i * 3] = n * scale, out[i * 3 + 1] = x * scale, out[i * 3 + 2] = y * scale;
      }
    }
  }
  if (b.velocity)
    for (int p = TID; p < s.parts; p += THREADS) {
      int j = load(s.position + p);
      int node = j >= 0 ? a.node_slot[j] : kNone;
      double* out = b.velocity + ((long long)index * s.parts + p) * 6;
      for (int r = 0; r < 6; r++) out[r] = node != kNone ? double(velocity[node * 6 + r]) : 0.0;
    }
}

// Takes the next state of the launch, -1 when there is none.
DEVICE int next_state(const Batch& b) {
#ifdef __CUDACC__
  __shared__ int drawn;
  SYNC;
  if (TID == 0) drawn = atomicAdd(b.ticket, 1);
  SYNC;
  int i = drawn;
#else
  int i = atomicAdd(b.ticket, 1);
#endif
  int count = b.list_count ? *b.list_count : b.count;
  return i >= count ? -1 : b.list ? b.list[i] : i;
}

// ---------------------------------------------------------------------------------------------------------------
// ADMM in float32.

// A group of contact points with its share of the iterate, in registers where a thread has one group for good.
struct Group {
  int node[2];
  float arm[6];
  Point<float> point[GROUP];  // zeros beyond the last point, which then do nothing
  float u[GROUP * 3], z[GROUP * 3];
};

DEVICE void load_group(const Structure& s, const State& a, int slot, Group& q) {
  int g = a.group[slot];
  q.node[0] = a.group_node[slot], q.node[1] = a.group_node[a.groups + slot];
#pragma unroll
  for (int k = 0; k < 6; k++) q.arm[k] = arm_of(s, k, g, 0.0f);
#pragma unroll
  for (int i = 0; i < GROUP; i++) q.point[i] = point_of(s, i, g, 0.0f);
}

DEVICE void project_group(const Cone<float>& cone, Group& q) {
#pragma unroll
  for (int i = 0; i < GROUP; i++) {
    q.z[i * 3] = q.u[i * 3], q.z[i * 3 + 1] = q.u[i * 3 + 1], q.z[i * 3 + 2] = q.u[i * 3 + 2];
    project(cone, q.z[i * 3], q.z[i * 3 + 1], q.z[i * 3 + 2]);
  }
}

DEVICE void start_group(const Structure& s, const State& a, const Batch& b, int index, int slot, Group& q) {
#pragma unroll
  for (int i = 0; i < GROUP * 3; i++) q.u[i] = 0.0f;
  if (!b.guess) return;
  int g = a.group[slot], count = load(s.group_count + g);
  const double* guess = b.guess + ((long long)index * s.points + load(s.group_first + g)) * 3;
#pragma unroll
  for (int i = 0; i < GROUP; i++)
    if (i < count)
#pragma unroll
      for (int k = 0; k < 3; k++) q.u[i * 3 + k] = float(guess[i * 3 + k] / scale_of(s, i, g));
}

// u += alpha (z - u - G^T w)
DEVICE void update_group(const Cone<float>& cone, float alpha, const float* w, Group& q) {
  float strain[6];
  strain_of(q.node, q.arm, w, strain);
#pragma unroll
  for (int i = 0; i < GROUP; i++) {
    float t[3];
    point_strain(q.point[i], strain, t[0], t[1], t[2]);
#pragma unroll
    for (int k = 0; k < 3; k++) q.u[i * 3 + k] += alpha * (q.z[i * 3 + k] - q.u[i * 3 + k] - t[k]);
  }
  project_group(cone, q);
}

// Writes the wrenches of z, or of 2 z - u.
template <bool Reflected>
DEVICE void write_iterate(const State& a, int slot, const Group& q, float* wrench) {
  float sum[6] = {};
#pragma unroll
  for (int i = 0; i < GROUP; i++) {
    float f[3];
#pragma unroll
    for (int k = 0; k < 3; k++) f[k] = Reflected ? 2 * q.z[i * 3 + k] - q.u[i * 3 + k] : q.z[i * 3 + k];
    add_point_force(q.point[i], f[0], f[1], f[2], sum);
  }
  write_wrench(a, slot, q.node, q.arm, sum, wrench);
}

// Whether a proof seems near, from float32 numbers; writes the wrenches of z.
DEVICE void screen_group(
    const Structure& s, const State& a, int slot, const Group& q, const float* w, float* wrench, Tally& tally) {
  int g = a.group[slot];
  float strain[6];
  strain_of(q.node, q.arm, w, strain);
  float worst = float(-kHuge), pressed = 0;
#pragma unroll
  for (int i = 0; i < GROUP; i++) {
    float n, x, y, scale = float(scale_of(s, i, g));
    point_strain(q.point[i], strain, n, x, y);
    worst = fmax(worst, support(float(s.friction), -n, -x, -y) / scale);
    pressed += q.z[i * 3] * scale;
  }
  tally.v[1] = fmax(tally.v[1], double(worst));
  tally.v[4] += pressed;
  write_iterate<false>(a, slot, q, wrench);
}

// Iterates of groups in memory, for states with more groups than threads.
DEVICE void load_iterate(const State& a, int slot, const float* u, const float* z, Group& q) {
#pragma unroll
  for (int i = 0; i < GROUP * 3; i++) q.u[i] = u[i * a.groups + slot], q.z[i] = z[i * a.groups + slot];
}
DEVICE void store_iterate(const State& a, int slot, float* u, float* z, const Group& q) {
#pragma unroll
  for (int i = 0; i < GROUP * 3; i++) u[i * a.groups + slot] = q.u[i], z[i * a.groups + slot] = q.z[i];
}

// Forces for the tests in float64: from memory, or from a copy of the registers that can be indexed.
template <bool OneEach>
DEVICE FromIterate source_of(const Structure& s, const State& a, const float* u, const Group& q, float* copy) {
  Cone<double> cone = Cone<double>::make(s.friction);
  if (!OneEach) return {u, 1, a.groups, cone};
#pragma unroll
  for (int i = 0; i < GROUP * 3; i++) copy[i] = q.u[i];
  return {copy, 0, 1, cone};
}

// `OneEach`: everything on chip, a thread keeps its group in registers. Else: memory in `scratch`, any number of groups.
template <bool OneEach>
DEVICE void run_admm(const Structure& s, const Options& o, const Batch& b) {
  const Cone<float> cone = Cone<float>::make(s.friction);
  const float alpha = float(o.relaxation);
  for (int index = next_state(b); index >= 0; index = next_state(b)) {
    char* base = OneEach ? POOL : b.scratch + BLOCK * b.scratch_stride;
    char* top = base;
    State a = restrict_to<true>(s, b.states + (long long)index * s.parts, top);
    Matrix<float> m;
    m.diagonal = take<float>(top, a.nodes * 36);
    m.lower = take<float>(top, a.storage * 36);
    float* x = take<float>(top, a.nodes * 6);
    float* between = take<float>(top, a.nodes * 6);
    float* w = take<float>(top, a.nodes * 6);
    double* proof_wrench = take<double>(top, a.groups * 12);
    float* wrench = reinterpret_cast<float*>(proof_wrench);
    float* u = take<float>(top, OneEach ? 0 : a.groups * GROUP * 3);
    float* z = take<float>(top, OneEach ? 0 : a.groups * GROUP * 3);
    if (top - base > b.pool_bytes || (OneEach && a.groups > ON_CHIP_GROUPS)) {
      if (TID == 0) b.large[atomicAdd(b.large_count, 1)] = index;
      continue;
    }
    Group q;
    for (int slot = TID; slot < a.groups; slot += THREADS) {
      load_group(s, a, slot, q);
      start_group(s, a, b, index, slot, q);
      project_group(cone, q);
      write_iterate<true>(a, slot, q, wrench);
      if (!OneEach) store_iterate(a, slot, u, z, q);
    }
    assemble(s, a, o.rho, s.local_single, m);
    bool good = factor(a, m);
    invert(a, m);
    int verdict = a.nodes ? kUndecided : kStable, iteration = 0;
    double residual = a.nodes ? kHuge : 0.0;
    while (good && verdict == kUndecided && iteration < o.iterations) {
      iteration++;
      for (int t = TID; t < a.nodes * 6; t += THREADS) x[t] = node_wrench(s, a, t / 6, t % 6, wrench);
      SYNC;
      solve(a, m, x, between, w);
      bool check = iteration >= o.first_check && (iteration - o.first_check) % o.check_every == 0;
      Tally tally = {{0, -kHuge, 0, 0, 0}};
      for (int slot = TID; slot < a.groups; slot += THREADS) {
        if (!OneEach) load_group(s, a, slot, q), load_iterate(a, slot, u, z, q);
        update_group(cone, alpha, w, q);
        if (check)
          screen_group(s, a, slot, q, w, wrench, tally);
        else
          write_iterate<true>(a, slot, q, wrench);
        if (!OneEach) store_iterate(a, slot, u, z, q);
      }
      SYNC;
      if (!check) continue;
      tally_nodes(s, a, wrench, w, tally);
      SYNC;
      if (decide(s, o, tally, 0.05, residual) != kUndecided) {
        float copy[GROUP * 3];
        verdict = judge(s, a, o, source_of<OneEach>(s, a, u, q, copy), w, proof_wrench, residual);
      }
      if (verdict == kUndecided) {
        for (int slot = TID; slot < a.groups; slot += THREADS) {
          if (!OneEach) load_group(s, a, slot, q), load_iterate(a, slot, u, z, q);
          write_iterate<true>(a, slot, q, wrench);
        }
        SYNC;
      }
    }
    if (verdict != kUndecided || o.interior_steps == 0) {
      float copy[GROUP * 3];
      write_result(s, a, b, index, verdict, residual, iteration, source_of<OneEach>(s, a, u, q, copy), w);
      continue;
    }
    for (int slot = TID; slot < a.groups; slot += THREADS) {
      if (!OneEach) load_group(s, a, slot, q), load_iterate(a, slot, u, z, q);
      int g = a.group[slot], count = load(s.group_count + g);
      float* out = b.handoff + ((long long)index * s.points + load(s.group_first + g)) * 3;
#pragma unroll
      for (int i = 0; i < GROUP * 3; i++)
        if (i < count * 3) out[i] = good ? q.z[i] : 0.0f;
    }
    if (TID == 0) {
      b.iterations[index] = iteration;
      b.open[atomicAdd(b.open_count, 1)] = index;
    }
  }
}

// ---------------------------------------------------------------------------------------------------------------
// The interior point method in float64: Mehrotra's predictor and corrector on
//   min 1/2 r.M r - g.r  over velocities r with G^T r in the dual cone.

struct Multipliers {
  double x[kRays], s[kRays];
};

DEVICE Multipliers load_point(const double* weights, const double* slacks, const State& a, int i, int slot) {
  Multipliers p;
#pragma unroll
  for (int k = 0; k < kRays; k++) {
    p.x[k] = weights[(i * kRays + k) * a.groups + slot];
    p.s[k] = slacks[(i * kRays + k) * a.groups + slot];
  }
  return p;
}

#if QUADRATIC
// Scaling point of Nesterov and Todd in coordinates in which the cone is its own dual.
struct Scaling {
  double v0, v1, v2, scale, det_s;
  DEVICE Scaling make(const Multipliers& p) {
    double det_x = p.x[0] * p.x[0] - p.x[1] * p.x[1] - p.x[2] * p.x[2];
    double det_s = p.s[0] * p.s[0] - p.s[1] * p.s[1] - p.s[2] * p.s[2];
    double fx = 1 / sqrt(det_x), fs = 1 / sqrt(det_s);
    double both = fx * fs * (p.x[0] * p.s[0] + p.x[1] * p.s[1] + p.x[2] * p.s[2]);
    double f = 1 / sqrt(2 * (1 + both));
    return {f * (fx * p.x[0] + fs * p.s[0]), f * (fx * p.x[1] - fs * p.s[1]), f * (fx * p.x[2] - fs * p.s[2]),
            sqrt(det_x / det_s), det_s};
  }
};

// Largest step along `d` that stays in the cone.
DEVICE double to_boundary(const double (&x)[3], const double (&d)[3]) {
  double a = d[0] * d[0] - d[1] * d[1] - d[2] * d[2];
  double b = x[0] * d[0] - x[1] * d[1] - x[2] * d[2];
  double c = x[0] * x[0] - x[1] * x[1] - x[2] * x[2];
  double reach = d[0] < 0 ? -x[0] / d[0] : kHuge;
  double discriminant = b * b - a * c;
  if (discriminant > 0) {
    double q = -(b + copysign(sqrt(discriminant), b));
    double t = a != 0 ? q / a : -1.0;
    if (t > 0) reach = fmin(reach, t);
    t = q != 0 ? c / q : -1.0;
    if (t > 0) reach = fmin(reach, t);
  }
  return reach;
}
#endif

// Steps of a contact point towards y = G^T (r + dr), and how far both may go. `predicted` is y of the predictor,
// null in the predictor itself.
DEVICE double point_step(
    double mu, const Multipliers& p, double target, const double* predicted, double n, double x, double y,
    double (&dx)[kRays], double (&ds)[kRays]) {
  double reach = kHuge;
#if QUADRATIC
  (void)predicted;
  Scaling w = Scaling::make(p);
  n /= mu;
  double along = 2 * (w.v0 * n + w.v1 * x + w.v2 * y), t = target / w.det_s;
  dx[0] = t * p.s[0] - w.scale * (along * w.v0 - n);
  dx[1] = -t * p.s[1] - w.scale * (along * w.v1 + x);
  dx[2] = -t * p.s[2] - w.scale * (along * w.v2 + y);
  ds[0] = n - p.s[0], ds[1] = x - p.s[1], ds[2] = y - p.s[2];
  reach = fmin(to_boundary(p.x, dx), to_boundary(p.s, ds));
#else
#pragma unroll
  for (int k = 0; k < 8; k++) {
    double inverse = 1 / p.s[k];
    double at = n + mu * (ray_x(k) * x + ray_y(k) * y), second = 0;
    if (predicted) {
      double before = predicted[0] + mu * (ray_x(k) * predicted[1] + ray_y(k) * predicted[2]);
      second = -p.x[k] * before * inverse * (before - p.s[k]);
    }
    ds[k] = at - p.s[k];
    dx[k] = (target - second - p.x[k] * at) * inverse;
    if (ds[k] < 0) reach = fmin(reach, -p.s[k] / ds[k]);
    if (dx[k] < 0) reach = fmin(reach, -p.x[k] / dx[k]);
  }
#endif
  return reach;
}

// Weight matrix (packed 00 01 02 11 12 22) and target force of a contact point.
DEVICE void point_system(
    double mu, const Multipliers& p, double target, const double* predicted, double (&w)[6], double (&b)[3]) {
#if QUADRATIC
  (void)predicted;
  Scaling v = Scaling::make(p);
  w[0] = v.scale * (2 * v.v0 * v.v0 - 1) / (mu * mu);
  w[1] = v.scale * 2 * v.v0 * v.v1 / mu;
  w[2] = v.scale * 2 * v.v0 * v.v2 / mu;
  w[3] = v.scale * (2 * v.v1 * v.v1 + 1);
  w[4] = v.scale * 2 * v.v1 * v.v2;
  w[5] = v.scale * (2 * v.v2 * v.v2 + 1);
  double t = target / v.det_s;
  b[0] = (p.x[0] + t * p.s[0]) / mu;
  b[1] = p.x[1] - t * p.s[1];
  b[2] = p.x[2] - t * p.s[2];
#else
  for (int k = 0; k < 6; k++) w[k] = 0;
  b[0] = b[1] = b[2] = 0;
#pragma unroll
  for (int k = 0; k < 8; k++) {
    double inverse = 1 / p.s[k];
    double ratio = p.x[k] * inverse, rx = mu * ray_x(k), ry = mu * ray_y(k), second = 0;
    if (predicted) {
      double before = predicted[0] + rx * predicted[1] + ry * predicted[2];
      second = -ratio * before * (before - p.s[k]);
    }
    w[0] += ratio, w[1] += ratio * rx, w[2] += ratio * ry;
    w[3] += ratio * rx * rx, w[4] += ratio * rx * ry, w[5] += ratio * ry * ry;
    double force = p.x[k] + (target - second) * inverse;
    b[0] += force, b[1] += force * rx, b[2] += force * ry;
  }
#endif
}

struct Interior {
  double *weights, *slacks;              // (GROUP, kRays, groups that act)
  double *r, *ahead, *step, *x, *between;          // (nodes, 6): velocity, velocity after a step, step, right-hand side
  double *wrench, *local;                // (2, 6, groups), (21, groups)
  Matrix<double> m;
};

// Writes the wrenches of the Newton step, and the groups' local matrices if asked for.
template <bool WithMatrix>
PHASE void prepare(const Structure& s, const State& a, const Interior& q, double target) {
  double mu = s.friction;
  for (int slot = TID; slot < a.groups; slot += THREADS) {
    int g = a.group[slot], count = load(s.group_count + g);
    double strain[6], ahead[6], sum[6] = {}, local[21];
#pragma unroll
    for (int k = 0; k < 21; k++) local[k] = 0;
    group_strain(s, a, slot, g, q.r, strain);
    if (!WithMatrix) group_strain(s, a, slot, g, q.ahead, ahead);
    for (int i = 0; i < count; i++) {
      Point<double> p = point_of(s, i, g, 0.0);
      double n, x, y, w[6], b[3], predicted[3];
      point_strain(p, strain, n, x, y);
      if (!WithMatrix) point_strain(p, ahead, predicted[0], predicted[1], predicted[2]);
      point_system(mu, load_point(q.weights, q.slacks, a, i, slot), target, WithMatrix ? nullptr : predicted, w, b);
      add_point_force(p, b[0] - w[0] * n - w[1] * x - w[2] * y, b[1] - w[1] * n - w[3] * x - w[4] * y,
                      b[2] - w[2] * n - w[4] * x - w[5] * y, sum);
      if (!WithMatrix) continue;
      double column[6][3];  // the point's 6 x 3 map
#pragma unroll
      for (int k = 0; k < 3; k++) {
        double fx = p.axis[k], fy = p.axis[3 + k], fz = p.axis[6 + k];
        column[0][k] = fx, column[1][k] = fy, column[2][k] = fz;
        column[3][k] = p.arm[1] * fz - p.arm[2] * fy;
        column[4][k] = p.arm[2] * fx - p.arm[0] * fz;
        column[5][k] = p.arm[0] * fy - p.arm[1] * fx;
      }
#pragma unroll
      for (int r = 0; r < 6; r++) {
        double h0 = column[r][0] * w[0] + column[r][1] * w[1] + column[r][2] * w[2];
        double h1 = column[r][0] * w[1] + column[r][1] * w[3] + column[r][2] * w[4];
        double h2 = column[r][0] * w[2] + column[r][1] * w[4] + column[r][2] * w[5];
#pragma unroll
        for (int c = 0; c <= r; c++)
          local[r * (r + 1) / 2 + c] += h0 * column[c][0] + h1 * column[c][1] + h2 * column[c][2];
      }
    }
    write_group_wrench(s, a, slot, g, sum, q.wrench);
    if (WithMatrix)
#pragma unroll
      for (int k = 0; k < 21; k++) q.local[k * a.groups + slot] = local[k];
  }
  SYNC;
}

// Component `r` of the momentum of a node's velocity.
DEVICE double momentum_of(const Structure& s, const State& a, const double* velocity, int node, int r) {
  int j = a.node[node];
  const double* v = velocity + node * 6;
  if (r < 3) return load(s.mass + j) * v[r];
  double total = 0;
  for (int c = 0; c < 3; c++) total += load(s.inertia + ((r - 3) * 3 + c) * s.positions + j) * v[3 + c];
  return total;
}

PHASE void newton_step(const Structure& s, const State& a, const Interior& q) {
  for (int t = TID; t < a.nodes * 6; t += THREADS)
    q.x[t] = node_wrench(s, a, t / 6, t % 6, q.wrench) - momentum_of(s, a, q.r, t / 6, t % 6);
  SYNC;
  solve_by_levels(a, q.m, q.x, q.between, q.step);
}

// Reach of a step, and its complementarity as a polynomial of its length: tally of reach, constant, linear, square.
template <bool Corrector>
PHASE void measure(const Structure& s, const State& a, const Interior& q, double target, double (&tally)[4]) {
  tally[0] = -kHuge, tally[1] = tally[2] = tally[3] = 0;
  for (int slot = TID; slot < a.groups; slot += THREADS) {
    int g = a.group[slot], count = load(s.group_count + g);
    double strain[6], ahead[6], step[6];
    group_strain(s, a, slot, g, q.ahead, ahead);
    if (Corrector) {
      group_strain(s, a, slot, g, q.r, strain);
      group_strain(s, a, slot, g, q.step, step);
      for (int k = 0; k < 6; k++) strain[k] += step[k];
    }
    for (int i = 0; i < count; i++) {
      Point<double> p = point_of(s, i, g, 0.0);
      double n, x, y, predicted[3], dx[kRays], ds[kRays];
      point_strain(p, ahead, predicted[0], predicted[1], predicted[2]);
      if (Corrector) point_strain(p, strain, n, x, y);
      Multipliers v = load_point(q.weights, q.slacks, a, i, slot);
      double reach = Corrector ? point_step(s.friction, v, target, predicted, n, x, y, dx, ds)
                               : point_step(s.friction, v, 0.0, nullptr, predicted[0], predicted[1], predicted[2], dx, ds);
      tally[0] = fmax(tally[0], -reach);
#pragma unroll
      for (int k = 0; k < kRays; k++) {
        tally[1] += v.x[k] * v.s[k];
        tally[2] += v.x[k] * ds[k] + dx[k] * v.s[k];
        tally[3] += dx[k] * ds[k];
      }
    }
  }
  reduce<1, 3>(tally);
}

PHASE void advance(const Structure& s, const State& a, const Interior& q, double target, double length) {
  for (int slot = TID; slot < a.groups; slot += THREADS) {
    int g = a.group[slot], count = load(s.group_count + g);
    double strain[6], ahead[6], step[6];
    group_strain(s, a, slot, g, q.ahead, ahead);
    group_strain(s, a, slot, g, q.r, strain);
    group_strain(s, a, slot, g, q.step, step);
    for (int k = 0; k < 6; k++) strain[k] += step[k];
    for (int i = 0; i < count; i++) {
      Point<double> p = point_of(s, i, g, 0.0);
      double n, x, y, predicted[3], dx[kRays], ds[kRays];
      point_strain(p, ahead, predicted[0], predicted[1], predicted[2]);
      point_strain(p, strain, n, x, y);
      Multipliers v = load_point(q.weights, q.slacks, a, i, slot);
      point_step(s.friction, v, target, predicted, n, x, y, dx, ds);
#pragma unroll
      for (int k = 0; k < kRays; k++) {
        q.weights[(i * kRays + k) * a.groups + slot] = v.x[k] + length * dx[k];
        q.slacks[(i * kRays + k) * a.groups + slot] = v.s[k] + length * ds[k];
      }
    }
  }
  SYNC;
  for (int t = TID; t < a.nodes * 6; t += THREADS) q.r[t] += length * q.step[t];
  SYNC;
}

// Velocity, multipliers and slacks inside the cones near what ADMM found; returns the number of contact points.
PHASE int start_interior(const Structure& s, const State& a, const Batch& b, int index, const Interior& q) {
  for (int slot = TID; slot < a.groups; slot += THREADS) {
    int g = a.group[slot], count = load(s.group_count + g);
    const float* z = b.handoff + ((long long)index * s.points + load(s.group_first + g)) * 3;
    double sum[6] = {};
    for (int i = 0; i < count; i++)
      add_point_force(point_of(s, i, g, 0.0), double(z[i * 3]), double(z[i * 3 + 1]), double(z[i * 3 + 2]), sum);
    write_group_wrench(s, a, slot, g, sum, q.wrench);
  }
  SYNC;
  for (int t = TID; t < a.nodes * 6; t += THREADS) q.x[t] = node_wrench(s, a, t / 6, t % 6, q.wrench);
  SYNC;
  for (int t = TID; t < a.nodes * 6; t += THREADS) {
    int node = t / 6, r = t % 6, j = a.node[node];
    double value = 0;
    if (r < 3)
      value = q.x[t] / load(s.mass + j);
    else
      for (int c = 0; c < 3; c++) value += load(s.flexibility + ((r - 3) * 3 + c) * s.positions + j) * q.x[node * 6 + 3 + c];
    q.r[t] = value;
  }
  SYNC;
  double mean[3] = {0, 0, 0};  // force, slack, number
  for (int pass = 0; pass < 2; pass++) {
    for (int slot = TID; slot < a.groups; slot += THREADS) {
      int g = a.group[slot], count = load(s.group_count + g);
      const float* z = b.handoff + ((long long)index * s.points + load(s.group_first + g)) * 3;
      double strain[6];
      group_strain(s, a, slot, g, q.r, strain);
      for (int i = 0; i < count; i++) {
        double n, x, y;
        point_strain(point_of(s, i, g, 0.0), strain, n, x, y);
        if (pass == 0) {
          mean[0] += z[i * 3], mean[1] += fabs(n), mean[2] += 1;
          continue;
        }
        double force = z[i * 3] + mean[0], slack = fmax(n, 0.0) + mean[1];
        for (int k = 0; k < kRays; k++) {
          int at = (i * kRays + k) * a.groups + slot;
#if QUADRATIC
          q.weights[at] = k == 0 ? s.friction * force : 0.0;
          q.slacks[at] = k == 0 ? slack / s.friction : 0.0;
#else
          q.weights[at] = force / 8;
          q.slacks[at] = slack;
#endif
        }
      }
    }
    if (pass == 0) {
      reduce<0, 3>(mean);
      double points = fmax(mean[2], 1.0);
      mean[0] = fmax(mean[0] / points, 1e-8), mean[1] = fmax(mean[1] / points, 1e-8);
    }
  }
  SYNC;
  return int(mean[2]);
}

template <bool InShared>
DEVICE void run_interior(const Structure& s, const Options& o, const Batch& b) {
  for (int index = next_state(b); index >= 0; index = next_state(b)) {
    char* base = InShared ? POOL : b.scratch + BLOCK * b.scratch_stride;
    char* top = base;
    State a = restrict_to<false>(s, b.states + (long long)index * s.parts, top);
    Interior q;
    q.m.diagonal = take<double>(top, a.nodes * 36);
    q.m.lower = take<double>(top, a.storage * 36);
    q.r = take<double>(top, a.nodes * 6);
    q.ahead = take<double>(top, a.nodes * 6);
    q.step = take<double>(top, a.nodes * 6);
    q.x = take<double>(top, a.nodes * 6);
    q.between = take<double>(top, a.nodes * 6);
    if (top - base > b.pool_bytes) {
      if (TID == 0) b.large[atomicAdd(b.large_count, 1)] = index;
      continue;
    }
    q.weights = reinterpret_cast<double*>(b.points_scratch + BLOCK * b.points_stride);
    q.slacks = q.weights + s.groups * GROUP * kRays;
    q.local = q.slacks + s.groups * GROUP * kRays;
    q.wrench = q.local + s.groups * 21;
    int points = start_interior(s, a, b, index, q);
    FromMultipliers source = {q.weights, s.friction};
    int verdict = kUndecided, step = 0;
    double residual = kHuge;
    while (verdict == kUndecided && step < o.interior_steps && points) {
      step++;
      prepare<true>(s, a, q, 0.0);
      assemble(s, a, 1.0, q.local, q.m);
      if (!factor(a, q.m)) break;
      newton_step(s, a, q);
      for (int t = TID; t < a.nodes * 6; t += THREADS) q.ahead[t] = q.r[t] + q.step[t];
      SYNC;
      double tally[4];
      measure<false>(s, a, q, 0.0, tally);
      double length = fmin(1.0, -tally[0]);
      double centring = fmax((tally[1] + length * (tally[2] + length * tally[3])) / tally[1], 0.0);
      double target = centring * centring * centring * tally[1] / points / (QUADRATIC ? 1 : 8);
      prepare<false>(s, a, q, target);
      newton_step(s, a, q);
      measure<true>(s, a, q, target, tally);
      length = fmin(1.0, kBackOff * -tally[0]);
      if (!(length > 0)) break;
      advance(s, a, q, target, length);
      verdict = judge(s, a, o, source, q.r, q.wrench, residual);
    }
    write_result(s, a, b, index, verdict, residual, b.iterations[index] + step, source, q.r);
  }
}

#if !defined(PART) || PART == 0
KERNEL((ADMM_THREADS, ADMM_BLOCKS)) admm_shared(Structure s, Options o, Batch b) { run_admm<true>(s, o, b); }
#endif
#if !defined(PART) || PART == 1
KERNEL((ADMM_THREADS, 1)) admm_scratch(Structure s, Options o, Batch b) { run_admm<false>(s, o, b); }
#endif
#if !defined(PART) || PART == 2
KERNEL((INTERIOR_THREADS, INTERIOR_BLOCKS)) interior_shared(Structure s, Options o, Batch b) { run_interior<true>(s, o, b); }
#endif
#if !defined(PART) || PART == 3
KERNEL((INTERIOR_THREADS, 1)) interior_scratch(Structure s, Options o, Batch b) { run_interior<false>(s, o, b); }
#endif
