// The criterion `contact`.

// Writes contact forces in N of a state at rest, and displacements in m and rad of one at rest or on its way.
PHASE void write_displaced(const Structure& s, const State& a, const Batch& b, int index, bool rests, const double* displacement) {
  if (rests && b.forces) {
    double* forces = b.forces + (long long)index * s.points * 3;
    for (int g = TID; g < s.groups; g += THREADS)
      if (a.group_slot[g] == kNone)
        for (int i = 0; i < load(s.group_count + g) * 3; i++) forces[load(s.group_first + g) * 3 + i] = 0;
    for (int slot = TID; slot < a.groups; slot += THREADS) {
      int g = a.group[slot];
      double* out = forces + load(s.group_first + g) * 3;
      double strain[6];
      group_strain(s, a, slot, g, displacement, strain);
      for (int i = 0; i < load(s.group_count + g); i++) {
        double n, x, y, scale = scale_of(s, i, g);
        spring_force(s, point_of(s, i, g, 0.0), i, g, strain, n, x, y);
        contact_force(s.friction, n, x, y);
        out[i * 3] = n * scale, out[i * 3 + 1] = x * scale, out[i * 3 + 2] = y * scale;
      }
    }
  }
  if (b.displacement)
    for (int p = TID; p < s.parts; p += THREADS) {
      int j = load(s.position + p);
      int node = j >= 0 ? a.node_slot[j] : kNone;
      double* out = b.displacement + ((long long)index * s.parts + p) * 6;
      for (int r = 0; r < 6; r++)
        out[r] = node != kNone ? displacement[node * 6 + r] * (r < 3 ? s.unit : s.unit / s.length) : 0.0;
    }
}

// The solvers of the equilibrium problem have not proved these states unstable. A state that does not rest slides where
// forces in equilibrium exist; where neither proof was found and parts move away, an infinite residual says so.
template <bool InShared>
DEVICE void run_contact(const Structure& s, const Options& o, const Batch& b) {
  for (int index = next_state(b); index >= 0; index = next_state(b)) {
    char* far = InShared ? nullptr : b.scratch + BLOCK * b.scratch_stride;
    char* top = InShared || b.near ? POOL : far;
    State a = restrict_to<false>(s, b.states + (long long)index * s.parts, top);
    Newton q;
    q.now = take<double>(top, a.nodes * 6);
    q.ahead = take<double>(top, a.nodes * 6);
    q.step = take<double>(top, a.nodes * 6);
    q.residual = take<double>(top, a.nodes * 6);
    q.ahead_residual = take<double>(top, a.nodes * 6);
    q.between = take<double>(top, a.nodes * 6);
    if (!InShared && b.near) top = far;
    q.m.diagonal = take<double>(top, a.nodes * 36);
    q.m.lower = take<double>(top, a.storage * 36);
    q.m.upper = take<double>(top, a.storage * 36);
    if (InShared && top - POOL > b.pool_bytes) {
      if (TID == 0) b.large[atomicAdd(b.large_count, 1)] = index;
      continue;
    }
    q.local = reinterpret_cast<double*>(b.points_scratch + BLOCK * b.points_stride);
    q.wrench = q.local + s.groups * 36;
    double residual;
    int steps, found = find_rest(s, a, o, q, residual, steps);
    if (found != kUndecided) write_displaced(s, a, b, index, found == kStable, q.now);
    if (TID == 0) {
      bool balanced = b.verdict[index] == kStable, moves = found == kMovesAway;
      b.iterations[index] += steps;
      if (found == kStable) b.residual[index] = residual;
      if (moves && !balanced) b.residual[index] = kHuge * kHuge;
      b.verdict[index] = int8_t(found == kStable ? kStable : moves && balanced ? kSlides : kUndecided);
    }
  }
}
