// Displacement at which contact forces balance the load: the contact law of contact/law.py, and the pseudo-transient
// Newton iterations of contact/newton.py from rest, in float64. Displacements are in units of `unit` metres and
// `unit / length` radians.

// Size of a tangential force, at most mu n inside the cone, and its gradient where it is not zero.
DEVICE double gauge(double x, double y) {
#if QUADRATIC
  return sqrt(x * x + y * y);
#else
  x = fabs(x), y = fabs(y);
  return fmax(x, y) + fmin(x, y) * 0.41421356237309503;
#endif
}
DEVICE void gauge_gradient(double x, double y, double size, double& gx, double& gy) {
#if QUADRATIC
  gx = x / size, gy = y / size;
#else
  (void)size;
  bool along = fabs(x) >= fabs(y);
  gx = copysign(along ? 1.0 : 0.41421356237309503, x), gy = copysign(along ? 0.41421356237309503 : 1.0, y);
#endif
}

// Force of a contact point whose springs alone would give (n, x, y).
DEVICE void contact_force(double mu, double& n, double& x, double& y) {
  if (!(n > 0)) {
    n = x = y = n <= 0 ? 0.0 : n;  // keeps NaN
    return;
  }
  double size = gauge(x, y), limit = mu * n;
  if (size <= limit) return;
  double share = limit / size;
  x *= share, y *= share;
}

struct Newton {
  double *now, *ahead, *step, *residual, *ahead_residual, *between;  // (nodes, 6)
  double *wrench, *local;                                            // (2, 6, groups), (36, groups)
  General m;
};

// Spring forces of a contact point, before they are cut to the law.
DEVICE void spring_force(
    const Structure& s, const Point<double>& p, int i, int g, const double (&strain)[6], double& n, double& x,
    double& y) {
  double k = load(s.stiffness + i * s.groups + g), kt = s.tangential * k;
  point_strain(p, strain, n, x, y);
  n *= -k, x *= -kt, y *= -kt;
}

// What an iteration needs to know of a displacement and the step that led there.
struct Progress {
  double v[5];  // residual, movement; squares of the residual's norm, residual on step, step on step
};

// Writes the residual wrenches of a displacement.
PHASE void evaluate(
    const Structure& s, const State& a, const Newton& q, const double* displacement, double* out, Progress& progress) {
  for (int slot = TID; slot < a.groups; slot += THREADS) {
    int g = a.group[slot], count = load(s.group_count + g);
    double strain[6], sum[6] = {};
    group_strain(s, a, slot, g, displacement, strain);
    for (int i = 0; i < count; i++) {
      Point<double> p = point_of(s, i, g, 0.0);
      double n, x, y;
      spring_force(s, p, i, g, strain, n, x, y);
      contact_force(s.friction, n, x, y);
      add_point_force(p, n, x, y, sum);
    }
    write_group_wrench(s, a, slot, g, sum, q.wrench);
  }
  SYNC;
#pragma unroll
  for (int i = 0; i < 5; i++) progress.v[i] = 0;
  for (int t = TID; t < a.nodes * 2; t += THREADS) {
    int node = t >> 1, j = a.node[node], half = t & 1;
    const double* u = displacement + t * 3;
    const double* step = q.step + t * 3;
    double f[3], mass = load(s.mass + j), measure = half ? load(s.gyration + j) : 1.0;
#pragma unroll
    for (int r = 0; r < 3; r++) out[t * 3 + r] = f[r] = node_wrench(s, a, node, half * 3 + r, q.wrench);
#pragma unroll
    for (int r = 0; r < 3; r++) {
      double acceleration = f[r] / mass, momentum = mass * step[r];
      if (half) {
        acceleration = momentum = 0;
#pragma unroll
        for (int c = 0; c < 3; c++) {
          acceleration += load(s.flexibility + (r * 3 + c) * s.positions + j) * f[c];
          momentum += load(s.inertia + (r * 3 + c) * s.positions + j) * step[c];
        }
      }
      progress.v[0] = fmax(progress.v[0], finite_or_huge(fabs(acceleration) * measure));
      progress.v[1] = fmax(progress.v[1], finite_or_huge(fabs(u[r]) * measure));
      progress.v[2] += f[r] * acceleration;
      progress.v[3] += f[r] * step[r];
      progress.v[4] += step[r] * momentum;
    }
  }
  reduce<2, 3>(progress.v);
  SYNC;
}

// Writes the groups' tangent stiffness. A contact that just touches counts as closed and rough, so the first step from
// rest is that of a bonded structure.
PHASE void write_tangent(const Structure& s, const State& a, const Newton& q) {
  double mu = s.friction;
  for (int slot = TID; slot < a.groups; slot += THREADS) {
    int g = a.group[slot], count = load(s.group_count + g);
    double strain[6], local[36];
#pragma unroll
    for (int k = 0; k < 36; k++) local[k] = 0;
    group_strain(s, a, slot, g, q.now, strain);
    for (int i = 0; i < count; i++) {
      Point<double> p = point_of(s, i, g, 0.0);
      double n, x, y, kn = load(s.stiffness + i * s.groups + g), kt = s.tangential * kn;
      spring_force(s, p, i, g, strain, n, x, y);
      if (n < 0) continue;
      double k10 = 0, k20 = 0, k11 = kt, k12 = 0, k21 = 0, k22 = kt, size = gauge(x, y);
      if (size > mu * n) {
        double ex = x / size, ey = y / size, gx, gy, share = kt * mu * n / size;
        gauge_gradient(x, y, size, gx, gy);
        k10 = mu * kn * ex, k20 = mu * kn * ey;
        k11 = share * (1 - ex * gx), k12 = -share * ex * gy;
        k21 = -share * ey * gx, k22 = share * (1 - ey * gy);
      }
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
        double h0 = column[r][0] * kn + column[r][1] * k10 + column[r][2] * k20;
        double h1 = column[r][1] * k11 + column[r][2] * k21;
        double h2 = column[r][1] * k12 + column[r][2] * k22;
#pragma unroll
        for (int c = 0; c < 6; c++)
          local[r * 6 + c] += h0 * column[c][0] + h1 * column[c][1] + h2 * column[c][2];
      }
    }
#pragma unroll
    for (int k = 0; k < 36; k++) q.local[k * a.groups + slot] = local[k];
  }
  SYNC;
}

constexpr int kMovesAway = -1;
constexpr double kGrowth = 4, kShortest = 0.1, kCut = 0.1, kLongestStep = 1e14;
constexpr double kFar = 10;  // times the limit on movement at which iterations end: on the way to rest they may overshoot

// Iterates from rest until the parts rest (kStable), move away (kMovesAway) or the steps are used up (kUndecided).
DEVICE int find_rest(const Structure& s, const State& a, const Options& o, Newton& q, double& residual, int& steps) {
  for (int t = TID; t < a.nodes * 6; t += THREADS) q.now[t] = q.step[t] = 0;
  SYNC;
  Progress progress;
  evaluate(s, a, q, q.now, q.residual, progress);
  double time = o.first_step, size = sqrt(progress.v[2]), moved = 0;
  residual = progress.v[0];
  for (steps = 0; residual > (1 - kMargin) * o.tolerance; steps++) {
    if (steps == o.contact_steps) return kUndecided;
    write_tangent(s, a, q);
    assemble_general(s, a, 1 / time, q.local, q.m);
    if (!factor_general(a, q.m)) {
      time *= kCut;
      continue;
    }
    for (int t = TID; t < a.nodes * 6; t += THREADS) q.ahead[t] = q.residual[t];
    SYNC;
    solve_general(a, q.m, q.ahead, q.between, q.step);
    double length = 1, ahead_size;
    while (true) {
      for (int t = TID; t < a.nodes * 6; t += THREADS) q.ahead[t] = q.now[t] + length * q.step[t];
      SYNC;
      evaluate(s, a, q, q.ahead, q.ahead_residual, progress);
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
    if (length == 1)
      time = fmin(time * fmax(kGrowth, size / fmax(ahead_size, 1e-300)), kLongestStep);
    else
      time *= 2 * length;
    size = ahead_size, residual = progress.v[0];
    double* kept = q.now;
    q.now = q.ahead, q.ahead = kept;
    kept = q.residual, q.residual = q.ahead_residual, q.ahead_residual = kept;
    moved = progress.v[1] * s.unit;
    if (moved > kFar * s.limit) {
      steps++;
      return kMovesAway;
    }
  }
  return moved > s.limit ? kMovesAway : kStable;
}
