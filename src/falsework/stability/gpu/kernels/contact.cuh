// The criterion `contact`.

// Writes contact forces in N of a state at rest, and displacements in m and rad of one at rest or moving.
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
        contact_force(friction_of(s, i, g), n, x, y);
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

// Newton iterations of a state that the solvers of the equilibrium problem have not proved unstable; false where it
// needs more memory than available. A state that does not come to rest slides where forces in equilibrium exist; where
// neither proof was found and parts move away, the residual is infinite.
template <bool InShared>
DEVICE bool settle_state(const Structure& s, const Options& o, const Batch& b, int index) {
  char* far = b.points_scratch + BLOCK * b.points_stride;
  char* top = InShared || b.near ? POOL : b.scratch + BLOCK * b.scratch_stride;
  State a = restrict_to<false>(s, b.states + (long long)index * s.parts, top);
  Newton q;
  q.now = take<double>(top, a.nodes * 6);
  q.ahead = take<double>(top, a.nodes * 6);
  q.residual = take<double>(top, a.nodes * 6);
  q.ahead_residual = take<double>(top, a.nodes * 6);
  q.step = take<float>(top, a.nodes * 6);
  q.right = take<float>(top, a.nodes * 6);
  q.between = take<float>(top, a.nodes * 6);
  if (!InShared && b.near) top = b.scratch + BLOCK * b.scratch_stride;
  q.m.diagonal = take<float>(top, a.nodes * 36);
  q.m.lower = take<float>(top, a.storage * 36);
  q.m.upper = take<float>(top, a.storage * 36);
  q.m.place_row = take<uint16_t>(top, a.storage);
  q.m.place_column = take<uint16_t>(top, a.storage);
  q.m.product_first = take<int>(top, a.nodes + a.storage + 1);
  if (InShared && top - POOL > b.pool_bytes) return false;
  // Products, and group data, are on chip too where there is room.
  long long room = InShared ? b.pool_bytes - (top - POOL) - 64 : 0;
  if (room >= s.products * 4) {
    room -= (s.products * 4 + 15) / 16 * 16;
    q.m.product = take<uint32_t>(top, s.products);
  } else {
    q.m.product = take<uint32_t>(far, s.products);
  }
  list_products(a, q.m);
  bool wrenches = room >= a.groups * 96, both = room >= a.groups * 240;
  q.trial = take<double>(far, a.groups * GROUP * 3);
  q.ahead_trial = take<double>(far, a.groups * GROUP * 3);
  q.wrench = reinterpret_cast<double*>(wrenches ? top : far);
  q.local = reinterpret_cast<float*>((both ? top : far) + a.groups * 96);
  double residual;
  int steps, found = equilibrate(s, a, o, q, residual, steps);
  if (found != kUndecided) write_displaced(s, a, b, index, found == kStable, q.now);
  if (TID == 0) {
    bool balanced = b.verdict[index] == kStable, moves = found == kMovesAway;
    b.iterations[index] += steps;
    if (found == kStable) b.residual[index] = residual;
    if (moves && !balanced) b.residual[index] = kHuge * kHuge;
    b.verdict[index] = int8_t(found == kStable ? kStable : moves && balanced ? kSlides : kUndecided);
  }
  return true;
}

// States from ADMM: first those that are not unstable, the last found before the others since they take longest;
// then, on idle multiprocessors, those that it leaves undecided.
DEVICE void run_contact_shared(const Structure& s, const Options& o, const Batch& b) {
  for (int i = next_ticket(b.ticket); i < *b.list_count; i = next_ticket(b.ticket)) {
    int index = b.list[*b.list_count - 1 - i];
    if (!settle_state<true>(s, o, b, index)) pass_on(b.rest, b.rest_count, index);
  }
  for (int i = next_ticket(b.open_ticket); i < *b.open_count; i = next_ticket(b.open_ticket)) {
    int index = b.open[i], verdict;
    if (!solve_interior<true>(s, o, b, index, verdict)) {
      pass_on(b.large, b.large_count, index);
      continue;
    }
    SYNC;
    if (verdict != kUnstable && !settle_state<true>(s, o, b, index)) pass_on(b.rest, b.rest_count, index);
  }
}

DEVICE void run_contact_scratch(const Structure& s, const Options& o, const Batch& b) {
  for (int index = next_state(b); index >= 0; index = next_state(b)) settle_state<false>(s, o, b, index);
}
