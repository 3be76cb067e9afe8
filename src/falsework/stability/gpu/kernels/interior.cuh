// The interior point method on one state.

struct Interior {
  double *weights, *slacks;              // (GROUP, kRays, groups that act)
  double *r, *ahead, *step, *x, *between;          // (nodes, 6): velocity, velocity after a step, step, right-hand side
  double *wrench, *local;                // (2, 6, groups), (21, groups)
  Matrix<double> m;
};

// Writes the wrenches of the Newton step, and the groups' local matrices if requested.
template <bool WithMatrix>
PHASE void prepare(const Structure& s, const State& a, const Interior& q, double target) {
  int bits = lane_bits(a.groups);
  for (int t0 = 0; t0 < a.groups << bits; t0 += THREADS) {
    int slot = (t0 + TID) >> bits, lane = (t0 + TID) & ((1 << bits) - 1), g = 0;
    double sum[6] = {}, local[21] = {};
    if (slot < a.groups) {
      g = a.group[slot];
      int count = load(s.group_count + g);
      double strain[6], ahead[6];
      group_strain(s, a, slot, g, q.r, strain);
      if (!WithMatrix) group_strain(s, a, slot, g, q.ahead, ahead);
      for (int i = lane; i < count; i += 1 << bits) {
        Point<double> p = point_of(s, i, g, 0.0);
        double n, x, y, w[6], b[3], predicted[3];
        point_strain(p, strain, n, x, y);
        if (!WithMatrix) point_strain(p, ahead, predicted[0], predicted[1], predicted[2]);
        point_system(friction_of(s, i, g), load_point(q.weights, q.slacks, a, i, slot), target,
                     WithMatrix ? nullptr : predicted, w, b);
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
    }
    sum_lanes(sum, bits);
    if (WithMatrix) sum_lanes(local, bits);
    if (slot >= a.groups || lane) continue;
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

// Largest feasible step, and complementarity as a polynomial of its length: tally of reach, constant, linear, square.
template <bool Corrector>
PHASE void measure(const Structure& s, const State& a, const Interior& q, double target, double (&tally)[4]) {
  tally[0] = -kHuge, tally[1] = tally[2] = tally[3] = 0;
  int bits = lane_bits(a.groups);
  for (int each = TID; each < a.groups << bits; each += THREADS) {
    int slot = each >> bits, g = a.group[slot], count = load(s.group_count + g);
    double strain[6], ahead[6], step[6];
    group_strain(s, a, slot, g, q.ahead, ahead);
    if (Corrector) {
      group_strain(s, a, slot, g, q.r, strain);
      group_strain(s, a, slot, g, q.step, step);
      for (int k = 0; k < 6; k++) strain[k] += step[k];
    }
    for (int i = each & ((1 << bits) - 1); i < count; i += 1 << bits) {
      Point<double> p = point_of(s, i, g, 0.0);
      double n, x, y, predicted[3], dx[kRays], ds[kRays];
      point_strain(p, ahead, predicted[0], predicted[1], predicted[2]);
      if (Corrector) point_strain(p, strain, n, x, y);
      Multipliers v = load_point(q.weights, q.slacks, a, i, slot);
      double mu = friction_of(s, i, g);
      double reach = Corrector ? point_step(mu, v, target, predicted, n, x, y, dx, ds)
                               : point_step(mu, v, 0.0, nullptr, predicted[0], predicted[1], predicted[2], dx, ds);
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
  int bits = lane_bits(a.groups);
  for (int each = TID; each < a.groups << bits; each += THREADS) {
    int slot = each >> bits, g = a.group[slot], count = load(s.group_count + g);
    double strain[6], ahead[6], step[6];
    group_strain(s, a, slot, g, q.ahead, ahead);
    group_strain(s, a, slot, g, q.r, strain);
    group_strain(s, a, slot, g, q.step, step);
    for (int k = 0; k < 6; k++) strain[k] += step[k];
    for (int i = each & ((1 << bits) - 1); i < count; i += 1 << bits) {
      Point<double> p = point_of(s, i, g, 0.0);
      double n, x, y, predicted[3], dx[kRays], ds[kRays];
      point_strain(p, ahead, predicted[0], predicted[1], predicted[2]);
      point_strain(p, strain, n, x, y);
      Multipliers v = load_point(q.weights, q.slacks, a, i, slot);
      point_step(friction_of(s, i, g), v, target, predicted, n, x, y, dx, ds);
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

// Velocity, multipliers and slacks inside the cones near the ADMM result; returns the number of contact points.
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
          q.weights[at] = k == 0 ? friction_of(s, i, g) * force : 0.0;
          q.slacks[at] = k == 0 ? slack / friction_of(s, i, g) : 0.0;
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

// The method on one state; false where it needs more memory than available.
template <bool InShared>
DEVICE bool solve_interior(const Structure& s, const Options& o, const Batch& b, int index, int& verdict) {
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
  if (top - base > b.pool_bytes) return false;
  q.weights = reinterpret_cast<double*>(b.points_scratch + BLOCK * b.points_stride);
  q.slacks = q.weights + s.groups * GROUP * kRays;
  q.local = q.slacks + s.groups * GROUP * kRays;
  q.wrench = q.local + s.groups * 21;
  int points = start_interior(s, a, b, index, q);
  FromMultipliers source = {q.weights, Friction::make(s)};
  int step = 0;
  verdict = kUndecided;
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
  return true;
}

template <bool InShared>
DEVICE void run_interior(const Structure& s, const Options& o, const Batch& b) {
  for (int index = next_state(b); index >= 0; index = next_state(b)) {
    int verdict;
    if (solve_interior<InShared>(s, o, b, index, verdict))
      ask_for_rest(o, b, index, verdict);
    else
      pass_on(b.large, b.large_count, index);
  }
}
