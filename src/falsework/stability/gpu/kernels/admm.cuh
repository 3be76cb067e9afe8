// ADMM in float32.

// A group of contact points with its share of the iterate, in registers where a thread keeps one group throughout.
struct Group {
  int node[2];
  float arm[6];
  Point<float> point[GROUP];  // zeros beyond the last point, which have no effect
  float u[GROUP * 3], z[GROUP * 3];
#if OWN_FRICTION
  float friction[GROUP];
#endif
};

DEVICE void load_group(const Structure& s, const State& a, int slot, Group& q) {
  int g = a.group[slot];
  q.node[0] = a.group_node[slot], q.node[1] = a.group_node[a.groups + slot];
#pragma unroll
  for (int k = 0; k < 6; k++) q.arm[k] = arm_of(s, k, g, 0.0f);
#pragma unroll
  for (int i = 0; i < GROUP; i++) q.point[i] = point_of(s, i, g, 0.0f);
#if OWN_FRICTION
#pragma unroll
  for (int i = 0; i < GROUP; i++) q.friction[i] = float(friction_of(s, i, g));
#endif
}

DEVICE void project_group(const Cone<float>& cone, Group& q) {
#pragma unroll
  for (int i = 0; i < GROUP; i++) {
    q.z[i * 3] = q.u[i * 3], q.z[i * 3 + 1] = q.u[i * 3 + 1], q.z[i * 3 + 2] = q.u[i * 3 + 2];
#if OWN_FRICTION
    project(Cone<float>::make(q.friction[i]), q.z[i * 3], q.z[i * 3 + 1], q.z[i * 3 + 2]);
#else
    project(cone, q.z[i * 3], q.z[i * 3 + 1], q.z[i * 3 + 2]);
#endif
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

// Whether a proof seems near, from float32 values; writes the wrenches of z.
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
    worst = fmax(worst, support(float(friction_of(s, i, g)), -n, -x, -y) / scale);
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

// Forces for the tests in float64: from memory, or from an indexable copy of the registers.
template <bool OneEach>
DEVICE FromIterate source_of(const Structure& s, const State& a, const float* u, const Group& q, float* copy) {
  Friction friction = Friction::make(s);
  if (!OneEach) return {u, 1, a.groups, friction};
#pragma unroll
  for (int i = 0; i < GROUP * 3; i++) copy[i] = q.u[i];
  return {copy, 0, 1, friction};
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
      pass_on(b.large, b.large_count, index);
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
      bool check = iteration % o.check_every == 0;
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
      ask_for_rest(o, b, index, verdict);
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
