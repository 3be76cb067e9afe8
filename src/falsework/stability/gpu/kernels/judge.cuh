// The two termination tests, in float64 whatever the precision of the iterates.

// Source of the forces of a contact point.
struct FromIterate {  // ADMM: the projection of u in float64, so that they lie in the cone to the last bit
  const float* u;
  int slot_stride, stride;
  Friction friction;
  DEVICE void force(const FromIterate& f, const State& a, int i, int slot, double& n, double& x, double& y) {
    const float* u = f.u + slot * f.slot_stride + i * 3 * f.stride;
    n = u[0], x = u[f.stride], y = u[2 * f.stride];
    project(Cone<double>::make(Friction::of(f.friction, i, a.group[slot])), n, x, y);
  }
};
struct FromMultipliers {
  const double* weights;
  Friction friction;
  DEVICE void force(const FromMultipliers& f, const State& a, int i, int slot, double& n, double& x, double& y) {
    const double* w = f.weights + (i * kRays) * a.groups + slot;
    double mu = Friction::of(f.friction, i, a.group[slot]);
#if QUADRATIC
    n = w[0] / mu, x = w[a.groups], y = w[2 * a.groups];
#else
    n = x = y = 0;
#pragma unroll
    for (int k = 0; k < 8; k++) {
      double v = w[k * a.groups];
      n += v, x += mu * ray_x(k) * v, y += mu * ray_y(k) * v;
    }
#endif
  }
};

// Contribution of a block's share of the state to the two tests.
struct Tally {
  double v[5];  // residual, largest power absorbed per newton; power of gravity, scaled momentum, sum of normals
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
    double mass = load(s.mass + j), measure = half ? load(s.gyration + j) : 1.0;
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
      tally.v[0] = fmax(tally.v[0], finite_or_huge(fabs(acceleration) * measure));
      tally.v[3] += fabs(momentum) / measure;
    }
  }
  reduce<2, 3>(tally.v);
}

// Verdict from the totals. `slack` loosens both tests: with 1 % of it they only tell whether a proof is near.
DEVICE int decide(const Structure& s, const Options& o, const Tally& tally, double slack, double& residual) {
  double bound = o.force_bound * s.weight;
  residual = tally.v[4] <= bound * (1 + slack) ? tally.v[0] : kHuge;
  if (residual < (1 - kMargin + slack) * o.resolution) return kStable;
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
      tally.v[1] = fmax(tally.v[1], finite_or_huge(support(friction_of(s, i, g), -n, -x, -y) / scale));
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
      for (int r = 0; r < 6; r++)
        out[r] = node != kNone ? double(velocity[node * 6 + r]) * (r < 3 ? s.length : 1.0) : 0.0;
    }
}

// Under the criterion `contact`, passes on a state that is not proven unstable.
DEVICE void ask_for_rest(const Options& o, const Batch& b, int index, int verdict) {
  if (o.contact_steps && verdict != kUnstable && TID == 0) b.rest[atomicAdd(b.rest_count, 1)] = index;
}

// Draws the next number; every thread returns it.
DEVICE int next_ticket(int* ticket) {
#ifdef __CUDACC__
  __shared__ int drawn;
  SYNC;
  if (TID == 0) drawn = atomicAdd(ticket, 1);
  SYNC;
  return drawn;
#else
  return atomicAdd(ticket, 1);
#endif
}

// Takes the next state of the launch, -1 when there is none.
DEVICE int next_state(const Batch& b) {
  int i = next_ticket(b.ticket), count = b.list_count ? *b.list_count : b.count;
  return i >= count ? -1 : b.list ? b.list[i] : i;
}

DEVICE void pass_on(int* list, int* count, int index) {
  if (TID == 0) list[atomicAdd(count, 1)] = index;
}
