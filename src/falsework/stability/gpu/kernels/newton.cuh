// Displacement at which contact forces balance the load: the contact law of contact/law.py, and the pseudo-transient
// Newton iterations of contact/newton.py from rest, in float64. Displacements are in units of `unit` metres and
// `unit / length` radians.

// Size of a tangential force, at most mu n inside the cone, and its gradient where it is not zero.
template <class T>
DEVICE T gauge(T x, T y) {
#if QUADRATIC
  return sqrt(x * x + y * y);
#else
  x = fabs(x), y = fabs(y);
  return fmax(x, y) + fmin(x, y) * T(0.41421356237309503);
#endif
}
DEVICE void gauge_gradient(float x, float y, float size, float& gx, float& gy) {
#if QUADRATIC
  gx = x / size, gy = y / size;
#else
  (void)size;
  bool along = fabs(x) >= fabs(y);
  gx = copysign(along ? 1.0f : 0.41421356f, x), gy = copysign(along ? 0.41421356f : 1.0f, y);
#endif
}

// Force of a contact point with elastic trial force (n, x, y).
DEVICE void contact_force(double mu, double& n, double& x, double& y) {
  if (!(n > 0)) {
    n = x = y = n <= 0 ? 0.0 : n;  // keeps NaN
    return;
  }
  double limit = mu * n;
#if QUADRATIC
  double square = x * x + y * y;
  if (square <= limit * limit) return;
  double share = limit * RECIPROCAL_ROOT(square);
#else
  double size = gauge(x, y);
  if (size <= limit) return;
  double share = limit / size;
#endif
  x *= share, y *= share;
}

struct Newton {
  double *now, *ahead, *residual, *ahead_residual;  // (nodes, 6)
  float *step, *right, *between;                    // (nodes, 6)
  double* wrench;                                   // (2, 6, groups)
  float* local;                                     // (groups, 36)
  double *trial, *ahead_trial;                      // (GROUP, 3, groups) elastic trial forces
  General m;
};

// Elastic trial force of a contact point.
DEVICE void spring_force(
    const Structure& s, const Point<double>& p, int i, int g, const double (&strain)[6], double& n, double& x,
    double& y) {
  double k = load(s.stiffness + i * s.groups + g), kt = s.tangential * k;
  point_strain(p, strain, n, x, y);
  n *= -k, x *= -kt, y *= -kt;
}

// Data of an iteration on a displacement and the step that led there.
struct Progress {
  double v[5];  // residual, movement; squares of the residual's norm, residual on step, step on step
};

// Writes the residual wrenches of a displacement, and the elastic trial forces.
PHASE void evaluate(
    const Structure& s, const State& a, const Newton& q, const double* displacement, double* trial, double* out,
    Progress& progress) {
  int bits = lane_bits(a.groups);
  for (int t0 = 0; t0 < a.groups << bits; t0 += THREADS) {
    int slot = (t0 + TID) >> bits, lane = (t0 + TID) & ((1 << bits) - 1), g = 0, node[2];
    double sum[6] = {}, arm[6];
    if (slot < a.groups) {
      g = a.group[slot];
      int count = load(s.group_count + g);
      double strain[6];
      node[0] = a.group_node[slot], node[1] = a.group_node[a.groups + slot];
#pragma unroll
      for (int k = 0; k < 6; k++) arm[k] = arm_of(s, k, g, 0.0);
      strain_of(node, arm, displacement, strain);
      for (int i = lane; i < count; i += 1 << bits) {
        Point<double> p = point_of(s, i, g, 0.0);
        double n, x, y;
        spring_force(s, p, i, g, strain, n, x, y);
        double* kept = trial + i * 3 * a.groups + slot;
        kept[0] = n, kept[a.groups] = x, kept[2 * a.groups] = y;
        contact_force(friction_of(s, i, g), n, x, y);
        add_point_force(p, n, x, y, sum);
      }
    }
    sum_lanes(sum, bits);
    if (slot < a.groups && lane == 0) write_wrench(a, slot, node, arm, sum, q.wrench);
  }
  SYNC;
#pragma unroll
  for (int i = 0; i < 5; i++) progress.v[i] = 0;
  bits = lane_bits(a.nodes * 2);
  for (int t0 = 0; t0 < (a.nodes * 2) << bits; t0 += THREADS) {
    int t = (t0 + TID) >> bits, lane = (t0 + TID) & ((1 << bits) - 1), half = t & 1;
    bool in = t < a.nodes * 2;
    int node = in ? t >> 1 : 0, j = a.node[node];
    double f[3] = {}, mass = load(s.mass + j), measure = half ? load(s.gyration + j) : 1.0;
    double reach = half ? load(s.reach + j) : 1.0, flexibility[9], inertia[9];
    if (half)  // prefetched to hide memory latency
#pragma unroll
      for (int k = 0; k < 9; k++)
        flexibility[k] = load(s.flexibility + k * s.positions + j), inertia[k] = load(s.inertia + k * s.positions + j);
    if (in)
      for (int k = a.incident_first[node] + lane, last = a.incident_last[node]; k < last; k += 1 << bits) {
        int code = a.incident[k];
        const double* from = q.wrench + ((code & 1) * 6 + half * 3) * a.groups + (code >> 1);
        f[0] += from[0], f[1] += from[a.groups], f[2] += from[2 * a.groups];
      }
    sum_lanes(f, bits);
    if (!in || lane) continue;
    const double* u = displacement + t * 3;
    const float* step = q.step + t * 3;
    double light = 1 / mass;
#pragma unroll
    for (int r = 0; r < 3; r++) out[t * 3 + r] = f[r] += load(s.gravity + (half * 3 + r) * s.positions + j);
#pragma unroll
    for (int r = 0; r < 3; r++) {
      double acceleration = f[r] * light, momentum = mass * step[r];
      if (half) {
        acceleration = momentum = 0;
#pragma unroll
        for (int c = 0; c < 3; c++) {
          acceleration += flexibility[r * 3 + c] * f[c];
          momentum += inertia[r * 3 + c] * step[c];
        }
      }
      progress.v[0] = fmax(progress.v[0], finite_or_huge(fabs(acceleration) * measure));
      progress.v[1] = fmax(progress.v[1], finite_or_huge(fabs(u[r]) * reach));
      progress.v[2] += f[r] * acceleration;
      progress.v[3] += f[r] * step[r];
      progress.v[4] += step[r] * momentum;
    }
  }
  reduce<2, 3>(progress.v);
  SYNC;
}

// Writes the groups' tangent stiffness at the trial forces. A contact that just touches counts as closed and sticking,
// so the first step from rest is that of a bonded structure.
PHASE void write_tangent(const Structure& s, const State& a, const Newton& q) {
  int bits = lane_bits(a.groups);
  for (int t0 = 0; t0 < a.groups << bits; t0 += THREADS) {
    int slot = (t0 + TID) >> bits, lane = (t0 + TID) & ((1 << bits) - 1);
    float local[36] = {};
    if (slot < a.groups) {
      int g = a.group[slot], count = load(s.group_count + g);
      for (int i = lane; i < count; i += 1 << bits) {
        const double* kept = q.trial + i * 3 * a.groups + slot;
        float n = float(kept[0]), x = float(kept[a.groups]), y = float(kept[2 * a.groups]);
        Point<float> p = point_of(s, i, g, 0.0f);
        float kn = float(load(s.stiffness + i * s.groups + g)), kt = float(s.tangential) * kn;
        if (n < 0) continue;
        float mu = float(friction_of(s, i, g));
        float k10 = 0, k20 = 0, k11 = kt, k12 = 0, k21 = 0, k22 = kt, size = gauge(x, y);
        if (size > mu * n) {
          float ex = x / size, ey = y / size, gx, gy, share = kt * mu * n / size;
          gauge_gradient(x, y, size, gx, gy);
          k10 = mu * kn * ex, k20 = mu * kn * ey;
          k11 = share * (1 - ex * gx), k12 = -share * ex * gy;
          k21 = -share * ey * gx, k22 = share * (1 - ey * gy);
        }
        float column[6][3];  // the point's 6 x 3 map
#pragma unroll
        for (int k = 0; k < 3; k++) {
          float fx = p.axis[k], fy = p.axis[3 + k], fz = p.axis[6 + k];
          column[0][k] = fx, column[1][k] = fy, column[2][k] = fz;
          column[3][k] = p.arm[1] * fz - p.arm[2] * fy;
          column[4][k] = p.arm[2] * fx - p.arm[0] * fz;
          column[5][k] = p.arm[0] * fy - p.arm[1] * fx;
        }
#pragma unroll
        for (int r = 0; r < 6; r++) {
          float h0 = column[r][0] * kn + column[r][1] * k10 + column[r][2] * k20;
          float h1 = column[r][1] * k11 + column[r][2] * k21;
          float h2 = column[r][1] * k12 + column[r][2] * k22;
#pragma unroll
          for (int c = 0; c < 6; c++)
            local[r * 6 + c] += h0 * column[c][0] + h1 * column[c][1] + h2 * column[c][2];
        }
      }
    }
    sum_lanes(local, bits);
    if (slot >= a.groups || lane) continue;
    float* out = q.local + slot * 36;
#pragma unroll
    for (int r = 0; r < 6; r++) {
      float row[6];
#pragma unroll
      for (int c = 0; c < 6; c++) row[c] = local[r * 6 + c];
      store_row(out + r * 6, row);
    }
  }
  SYNC;
}

constexpr int kMovesAway = -1;
constexpr double kGrowth = 4, kShortest = 0.1, kCut = 0.1, kLongestStep = 1e14;
constexpr double kFar = 10;  // times the displacement limit at which iterations end: they may overshoot
constexpr double kSettlements = 100;  // movement up to which a structure stands, as `SETTLEMENTS` of stiffness.py

// Returns whether a movement in m exceeds the limit at the trial forces, as `moves_far` on the CPU.
DEVICE bool moves_far(const Structure& s, const State& a, const Newton& q, double moved) {
  if (moved <= s.limit) return false;  // the same for all threads
  double settles[1] = {};
  for (int t = TID; t < a.groups; t += THREADS) {
    int g = a.group[t], count = load(s.group_count + g);
    for (int i = 0; i < count; i++) {
      Point<double> p = point_of(s, i, g, 0.0);
      double scale = sqrt(p.axis[0] * p.axis[0] + p.axis[3] * p.axis[3] + p.axis[6] * p.axis[6]);
      settles[0] = fmax(settles[0], q.trial[i * 3 * a.groups + t] / (load(s.stiffness + i * s.groups + g) * scale));
    }
  }
  reduce<1, 0>(settles);
  SYNC;
  return moved > kSettlements * settles[0] * s.unit;
}

// Iterates from rest until the parts come to rest (kStable), move away (kMovesAway) or steps run out (kUndecided).
DEVICE int equilibrate(const Structure& s, const State& a, const Options& o, Newton& q, double& residual, int& steps) {
  for (int t = TID; t < a.nodes * 6; t += THREADS) q.now[t] = 0, q.step[t] = 0;
  SYNC;
  double time = o.first_step, size = kHuge;
  for (steps = -1; steps < o.contact_steps; steps++) {
    double length = 1, ahead_size;
    Progress progress;
    if (steps >= 0) {  // the first pass evaluates rest itself, so that the code for that is there once
      for (int t = TID; t < a.nodes * 6; t += THREADS) q.right[t] = float(q.residual[t]);
      write_tangent(s, a, q);
      assemble_general(s, a, 1 / time, q.local, q.m);
      if (!factor_general(a, q.m, q.right)) {
        time *= kCut;
        continue;
      }
      solve_general(a, q.m, q.right, q.between, q.step);
    }
    while (true) {
      for (int t = TID; t < a.nodes * 6; t += THREADS) q.ahead[t] = q.now[t] + length * q.step[t];
      SYNC;
      evaluate(s, a, q, q.ahead, q.ahead_trial, q.ahead_residual, progress);
      ahead_size = sqrt(progress.v[2]);
      // Residual of the implicit Euler step: r - (length / time) M step.
      double c = length / time, implicit = progress.v[2] - 2 * c * progress.v[3] + c * c * progress.v[4];
      if (implicit <= size * size || ahead_size <= size) break;
      length *= 0.5;
      if (length < kShortest) break;
    }
    if (length < kShortest || !(ahead_size < kHuge)) {
      time *= kCut;
      continue;
    }
    if (steps >= 0 && length == 1)
      time = fmin(time * fmax(kGrowth, size / fmax(ahead_size, 1e-300)), kLongestStep);
    else if (steps >= 0)
      time *= 2 * length;
    size = ahead_size, residual = progress.v[0];
    double* kept = q.now;
    q.now = q.ahead, q.ahead = kept;
    kept = q.residual, q.residual = q.ahead_residual, q.ahead_residual = kept;
    kept = q.trial, q.trial = q.ahead_trial, q.ahead_trial = kept;
    double moved = progress.v[1] * s.unit;
    bool rests = residual <= (1 - kMargin) * o.resolution;
    bool far = moves_far(s, a, q, rests ? moved : moved / kFar);
    if (rests || far) {
      steps++;
      return far ? kMovesAway : kStable;
    }
  }
  return kUndecided;
}
