// Stability of partial structures, one state per thread block, on chip from the first iteration to the proof.
//
// The mathematics is that of the CPU solver (admm.py, interior_point.py, termination.py), with two differences.
// Velocities and wrenches stay in the world frame about the centres of mass instead of being whitened: S is
// then L S L^T, its solution is the virtual velocity itself, and the map of a contact point needs 12 numbers and
// the map of a pair 6 instead of 18 and 72. Factor and solves run by levels of the elimination tree.
//
// Compiled at run time for the present device. Without CUDA the file is plain C++ with one thread per block: every
// phase between two barriers is a loop with the stride of the block, so the same code then runs sequentially.

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
#define ALL(x) bool(__syncthreads_and(x))  // also waits
#define DEVICE static __device__ __forceinline__
#define PHASE static __device__ PHASE_INLINE
#define METHOD __device__ __forceinline__
#define KERNEL(bounds) extern "C" __global__ void __launch_bounds__ bounds
#define POPCOUNT __popc
#define RECIPROCAL_ROOT rsqrt
#define RECIPROCAL(x) __fdividef(1.0f, x)
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
#define ALL(x) (x)
#define DEVICE static inline
#define PHASE static
#define METHOD inline
#define KERNEL(bounds) extern "C" void
#define POPCOUNT __builtin_popcount
#define RECIPROCAL_ROOT(x) (1 / sqrt(x))
#define RECIPROCAL(x) (1 / (x))
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
#ifndef OWN_FRICTION
#define OWN_FRICTION 0  // whether points differ in friction
#endif
#ifndef GROUP
#define GROUP 4  // most contact points per thread
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

#ifndef CONTACT_THREADS
#define CONTACT_THREADS 256
#endif
#ifndef CONTACT_BLOCKS
#define CONTACT_BLOCKS 1
#endif

#ifdef __CUDACC__
#define ON_CHIP_GROUPS THREADS
#else
#define ON_CHIP_GROUPS 1
#endif

constexpr int kRays = QUADRATIC ? 3 : 8;  // multipliers per contact point
constexpr int kStable = 1, kUnstable = -1, kUndecided = 0, kSlides = -2;
constexpr double kMargin = 1e-3;  // both tests are stricter by this share, so that rounding cannot overturn them
constexpr double kBackOff = 0.99;
constexpr double kHuge = 1e300;
constexpr uint16_t kNone = 0xffff;

// Arrays of one structure; positions are parts in elimination order, groups are runs of contact points of a pair.
// Lengths are in units of `length` metres, accelerations in units of gravity; force scales and `weight` in N.
struct Structure {
  int parts, positions, groups, blocks, levels, points;
  int products;              // of two blocks, in the factor of the complete structure at most
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
  const float* point_single; // (GROUP, 3, groups, 4): scaled axes by rows, then lever arm from the pair's centre
  const double* point;       // (GROUP, 13, groups): the same, then the force scale
  const float* arm_single;   // (6, groups): from the centres of parts a and b to the pair's centre
  const double* arm;
  const float* local_single; // (21, groups): lower triangle of the group's share of G G^T about the centre
  const double* mass;        // (positions,)
  const double* inertia;     // (9, positions)
  const double* flexibility; // (9, positions) inverse inertia
  const double* gravity;     // (6, positions)
  const double* gyration;    // (positions,) largest radius of gyration
  const double* reach;       // (positions,) distance of the farthest corner, under the criterion `contact`; else null
  const double* stiffness;   // (GROUP, groups) normal, under the criterion `contact`; else null
  const double* own_friction; // (GROUP, groups) of each point where OWN_FRICTION, `friction` in all others; else null
  double weight, friction, length;
  double tangential;         // ratio of tangential to normal stiffness
  double unit;               // metres of displacement of a variable of 1
  double limit;              // movement of a part that counts as collapsing, m
};

struct Options {
  double rho, relaxation;
  double tolerance;          // what a velocity proves exceeds it
  double resolution;         // what forces leave is below it
  double force_bound, first_step;
  int iterations, check_every, interior_steps;
  int contact_steps;         // Newton iterations; 0 under the criterion `equilibrium`
};

// One launch. `list` names the states to process (all where it is null); `*_count` are in device memory.
struct Batch {
  const uint8_t* states;   // (batch, parts)
  const double* guess;     // (batch, points, 3) N, or null
  int8_t* verdict;
  double* residual;
  int* iterations;
  double* forces;          // (batch, points, 3) N, or null
  double* velocity;        // (batch, parts, 6), or null
  double* displacement;    // (batch, parts, 6) m and rad of states at rest or moving away, or null
  float* handoff;          // (batch, points, 3) scaled forces, from ADMM to the interior point method
  const int* list;
  const int* list_count;
  int* ticket;
  int* large;              // states that need more memory than this launch has
  int* large_count;
  int* open;               // states that ADMM leaves undecided
  int* open_count;
  int* open_ticket;
  int* rest;               // states for which the Newton iterations decide whether they come to rest
  int* rest_count;
  char* scratch;           // `scratch_stride` bytes per block, where the pool is not in shared memory
  long long scratch_stride;
  char* points_scratch;    // `points_stride` bytes per block: group data of the later methods
  long long points_stride;
  long long pool_bytes;
  int near;                // whether the Newton iterations keep all but their matrices in shared memory
  int count;
};

// Reductions over a block. The order of summation depends only on the number of threads.

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

// Logarithm of the number of neighbouring threads that share an item and add up their parts, where there are fewer
// items than threads.
DEVICE int lane_bits(int items) {
  int bits = 0;
  while (bits < 3 && items << (bits + 1) <= THREADS) bits++;
  return bits;
}
// All values take a step of the sum before any takes the next, so that they do not wait for each other.
template <class T, int N>
DEVICE void sum_lanes(T (&x)[N], int bits) {
#ifdef __CUDACC__
  for (int step = (1 << bits) >> 1; step; step >>= 1)
#pragma unroll
    for (int k = 0; k < N; k++) x[k] += __shfl_xor_sync(0xffffffffu, x[k], step);
#else
  (void)x, (void)bits;
#endif
}

DEVICE double finite_or_huge(double x) { return x < kHuge ? x : kHuge; }  // also for NaN
