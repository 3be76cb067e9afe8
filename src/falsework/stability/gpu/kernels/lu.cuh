// The tangent stiffness of a state and its block factor, in float32: whether a state rests is read off wrenches in
// float64, so the precision of a step matters only for how many are needed, and there are as many as in float64. Where
// contact points slide the matrix is not symmetric, so the blocks above the diagonal are kept too, transposed, in the
// places of their mirror images: both then fill by rows alike.

struct General {
  float* diagonal;  // (nodes, 36): the matrix, then the inverse pivots
  float* lower;     // (storage, 36): L with unit diagonal
  float* upper;     // (storage, 36): transposed blocks of U, at the end with unit diagonal too
};

// Six numbers of a row, which are 24 bytes.
DEVICE void load_row(const float* row, float (&out)[6]) {
#ifdef __CUDACC__
  const float2* p = reinterpret_cast<const float2*>(row);
  float2 a = p[0], b = p[1], c = p[2];
  out[0] = a.x, out[1] = a.y, out[2] = b.x, out[3] = b.y, out[4] = c.x, out[5] = c.y;
#else
  for (int k = 0; k < 6; k++) out[k] = row[k];
#endif
}
DEVICE void store_row(float* row, const float (&in)[6]) {
#ifdef __CUDACC__
  float2* p = reinterpret_cast<float2*>(row);
  p[0] = make_float2(in[0], in[1]), p[1] = make_float2(in[2], in[3]), p[2] = make_float2(in[4], in[5]);
#else
  for (int k = 0; k < 6; k++) row[k] = in[k];
#endif
}

// Adds the products of a row with the six rows of a block.
DEVICE void add_products(const float (&x)[6], const float* block, float (&out)[6]) {
#pragma unroll
  for (int k = 0; k < 6; k++) {
    float y[6];
    load_row(block + k * 6, y);
    out[k] += (x[0] * y[0] + x[1] * y[1]) + (x[2] * y[2] + x[3] * y[3]) + (x[4] * y[4] + x[5] * y[5]);
  }
}

// Row `r` of T_left local T_right^T, or of T_left local^T T_right^T, added to `out` with a sign.
template <bool Transposed>
DEVICE void add_general_row(
    const Structure& s, const float* local, int g, int r, int left, int right, float sign, float (&out)[6]) {
  auto entries = [&](int i, float (&v)[6]) {
    if (!Transposed)
      load_row(local + i * 6, v);
    else
#pragma unroll
      for (int k = 0; k < 6; k++) v[k] = local[k * 6 + i];
  };
  float v[6];
  entries(r, v);
  if (r >= 3) {
    int q = r - 3, q1 = q == 2 ? 0 : q + 1, q2 = q == 0 ? 2 : q - 1;
    float a1 = arm_of(s, left * 3 + q1, g, 0.0f), a2 = arm_of(s, left * 3 + q2, g, 0.0f), v1[6], v2[6];
    entries(q1, v1), entries(q2, v2);
#pragma unroll
    for (int k = 0; k < 6; k++) v[k] += a1 * v2[k] - a2 * v1[k];
  }
  float x = arm_of(s, right * 3, g, 0.0f), y = arm_of(s, right * 3 + 1, g, 0.0f), z = arm_of(s, right * 3 + 2, g, 0.0f);
  out[0] += sign * v[0], out[1] += sign * v[1], out[2] += sign * v[2];
  out[3] += sign * (v[3] + y * v[2] - z * v[1]);
  out[4] += sign * (v[4] + z * v[0] - x * v[2]);
  out[5] += sign * (v[5] + x * v[1] - y * v[0]);
}

// Sum of the groups' local matrices, (groups that act, 36), plus `shift` times the masses.
PHASE void assemble_general(const Structure& s, const State& a, double shift, const float* local, General m) {
  for (int t = TID; t < (a.nodes + 2 * a.storage) * 6; t += THREADS) {
    int item = t / 6, r = t % 6;
    float out[6] = {};
    float* row;
    if (item < a.nodes) {
      int j = a.node[item];
      row = m.diagonal + t * 6;
      if (r < 3) {
#pragma unroll
        for (int k = 0; k < 3; k++) out[k] = r == k ? float(shift * load(s.mass + j)) : 0.0f;
      } else {
#pragma unroll
        for (int k = 0; k < 3; k++) out[3 + k] = float(shift * load(s.inertia + ((r - 3) * 3 + k) * s.positions + j));
      }
      for (int k = a.incident_first[item]; k < a.incident_last[item]; k++) {
        int code = a.incident[k], slot = code >> 1;
        add_general_row<false>(s, local + slot * 36, a.group[slot], r, code & 1, code & 1, 1.0f, out);
      }
    } else {
      bool above = item >= a.nodes + a.storage;
      int place = item - a.nodes - (above ? a.storage : 0);
      row = (above ? m.upper : m.lower) + place * 36 + r * 6;
      int e = a.block_pattern[a.place_block[place]], last = load(s.block_start + e + 1);
      for (int k = load(s.block_start + e); k < last; k++) {
        int g = load(s.block_group + k), slot = a.group_slot[g];
        int side = load(s.position + load(s.group_part + s.groups + g)) == load(s.block_row + e);
        if (above)
          add_general_row<true>(s, local + slot * 36, g, r, side, 1 - side, -1.0f, out);
        else
          add_general_row<false>(s, local + slot * 36, g, r, side, 1 - side, -1.0f, out);
      }
    }
    store_row(row, out);
  }
  SYNC;
}

DEVICE void swap_if(bool yes, float& x, float& y) {
  float kept = x;
  x = yes ? y : x, y = yes ? kept : y;
}

// Inverse of a 6 x 6 block in place by elimination with exchange of rows; false if it is singular, and then it is left as
// it was.
DEVICE bool eliminate_block(float* block) {
  float m[6][6];
#pragma unroll
  for (int i = 0; i < 36; i++) m[i / 6][i % 6] = block[i];
  uint32_t swaps = 0;  // rows are exchanged one by one on the way to the pivot, so that all indices are constants
  bool good = true;
#pragma unroll
  for (int k = 0; k < 6; k++) {
#pragma unroll
    for (int i = k + 1; i < 6; i++) {
      bool yes = fabs(m[i][k]) > fabs(m[k][k]);
      swaps |= uint32_t(yes) << (k * 5 + i - 1 - k * (k + 1) / 2);
#pragma unroll
      for (int j = 0; j < 6; j++) swap_if(yes, m[k][j], m[i][j]);
    }
    good = good && fabs(m[k][k]) > 1e-30f;
    float inverse = 1.0f / m[k][k];
    m[k][k] = 1.0f;
#pragma unroll
    for (int j = 0; j < 6; j++) m[k][j] *= inverse;
#pragma unroll
    for (int i = 0; i < 6; i++) {
      if (i == k) continue;
      float share = m[i][k];
      m[i][k] = 0.0f;
#pragma unroll
      for (int j = 0; j < 6; j++) m[i][j] -= share * m[k][j];
    }
  }
  if (!good) return false;
#pragma unroll
  for (int k = 4; k >= 0; k--)
#pragma unroll
    for (int i = 5; i > k; i--) {
      bool yes = swaps >> (k * 5 + i - 1 - k * (k + 1) / 2) & 1;
#pragma unroll
      for (int j = 0; j < 6; j++) swap_if(yes, m[j][k], m[j][i]);
    }
#pragma unroll
  for (int i = 0; i < 36; i++) block[i] = m[i / 6][i % 6];
  return true;
}

// Inverts some 6 x 6 blocks in place; `bad` becomes 1 where one is singular. Nearly all need no exchange of rows, and
// then six threads, one a row, invert a block.
DEVICE void invert_blocks(float* blocks, int count, double& bad) {
#ifdef __CUDACC__
  int lane = TID & 31, i = lane % 8, warps = THREADS >> 5;
  for (int first = (TID >> 5) * 4; first < count; first += warps * 4) {
    float* block = blocks + (first + lane / 8) * 36;
    bool in = first + lane / 8 < count && i < 6, good = true;
    float row[6];
#pragma unroll
    for (int k = 0; k < 6; k++) row[k] = i == k ? 1.0f : 0.0f;
    if (in) load_row(block + i * 6, row);
#pragma unroll
    for (int k = 0; k < 6; k++) {
      float pivot = __shfl_sync(0xffffffffu, row[k], k, 8);
      good = good && fabs(pivot) > 1e-30f && (i <= k || fabs(pivot) >= 0.1f * fabs(row[k]));
      float inverse = RECIPROCAL(pivot), share = i == k ? 0.0f : row[k];
      row[k] = i == k ? 1.0f : 0.0f;
#pragma unroll
      for (int j = 0; j < 6; j++) {
        float above = __shfl_sync(0xffffffffu, row[j], k, 8) * inverse;
        row[j] = i == k ? above : row[j] - share * above;
      }
    }
    bool all = (__ballot_sync(0xffffffffu, good || !in) >> (lane & 24) & 0xff) == 0xff;
    if (in && all)
      store_row(block + i * 6, row);
    else if (in && i == 0 && !eliminate_block(block))
      bad = 1;
  }
#else
  for (int i = 0; i < count; i++)
    if (!eliminate_block(blocks + i * 36)) bad = 1;
#endif
}

// Replaces the matrix, level by level, by its factor; false where a pivot block is singular.
PHASE bool factor_general(const State& a, General m) {
  double bad[1] = {0};
  for (int level = 0; level < a.levels; level++) {
    int node0 = a.level_node[level], nodes = a.level_node[level + 1] - node0;
    int place0 = a.place_first[node0], blocks = a.place_first[node0 + nodes] - place0;
    int rows = level ? (nodes + 2 * blocks) * 6 : 0, bits = lane_bits(rows);
    for (int t0 = 0; t0 < rows << bits; t0 += THREADS) {
      int t = (t0 + TID) >> bits, lane = (t0 + TID) & ((1 << bits) - 1), item = t / 6, r = t - item * 6;
      bool above = item >= nodes + blocks;
      int place = place0 + item - nodes - (above ? blocks : 0);
      float* row = nullptr;
      float sum[6] = {};
      if (t < rows) {
        int j = node0 + item, up = 0;
        if (item >= nodes) {
          int b = a.place_block[place];
          j = a.block_column[b];
          up = b - a.column[j] + 1;
        }
        const float* mine = (above ? m.upper : m.lower) + r * 6;
        const float* other = above ? m.lower : m.upper;
        row = (item < nodes ? m.diagonal + j * 36 : (above ? m.upper : m.lower) + place * 36) + r * 6;
        for (int n = a.row[j] + lane, last = a.row[j + 1]; n < last; n += 1 << bits) {
          int right = a.row_block[n], left = a.stored[right + up];
          if (left < 0) continue;
          float x[6];
          load_row(mine + left * 36, x);
          add_products(x, other + a.stored[right] * 36, sum);
        }
      }
      sum_lanes(sum, bits);
      if (t < rows && lane == 0) {
        float x[6];
        load_row(row, x);
#pragma unroll
        for (int k = 0; k < 6; k++) x[k] -= sum[k];
        store_row(row, x);
      }
    }
    SYNC;
    invert_blocks(m.diagonal + node0 * 36, nodes, bad[0]);
    SYNC;
    for (int t = TID; t < blocks * 6; t += THREADS) {
      int place = place0 + t / 6;
      float* row = m.lower + place * 36 + t % 6 * 6;
      const float* d = m.diagonal + a.block_column[a.place_block[place]] * 36;
      float x[6], out[6] = {};
      load_row(row, x);
#pragma unroll
      for (int k = 0; k < 6; k++) {
        float y[6];
        load_row(d + k * 6, y);
#pragma unroll
        for (int c = 0; c < 6; c++) out[c] += x[k] * y[c];
      }
      store_row(row, out);
    }
    SYNC;
  }
  for (int t = TID; t < a.storage * 6; t += THREADS) {
    float* row = m.upper + t * 6;
    float x[6], out[6] = {};
    load_row(row, x);
    add_products(x, m.diagonal + a.block_column[a.place_block[t / 6]] * 36, out);
    store_row(row, out);
  }
  SYNC;
  reduce<1, 0>(bad);
  SYNC;
  return bad[0] == 0;
}

// Solves with the factor, level by level; overwrites x.
PHASE void solve_general(const State& a, General m, float* x, float* between, float* out) {
  for (int level = 1; level < a.levels; level++) {
    int first = a.level_node[level] * 6, items = a.level_node[level + 1] * 6 - first, bits = lane_bits(items);
    for (int t0 = 0; t0 < items << bits; t0 += THREADS) {
      int t = (t0 + TID) >> bits, lane = (t0 + TID) & ((1 << bits) - 1), i = (first + t) / 6, r = first + t - i * 6;
      float sum[1] = {0};
      if (t < items)
        for (int k = a.row[i] + lane, last = a.row[i + 1]; k < last; k += 1 << bits) {
          int b = a.row_block[k];
          sum[0] += dot6(m.lower + a.stored[b] * 36 + r * 6, x + a.block_column[b] * 6);
        }
      sum_lanes(sum, bits);
      if (t < items && lane == 0) x[first + t] -= sum[0];
    }
    SYNC;
  }
  for (int t = TID; t < a.nodes * 6; t += THREADS) between[t] = dot6(m.diagonal + t * 6, x + t / 6 * 6);
  SYNC;
  for (int level = a.levels - 1; level >= 0; level--) {
    int first = a.level_node[level] * 6, items = a.level_node[level + 1] * 6 - first, bits = lane_bits(items);
    for (int t0 = 0; t0 < items << bits; t0 += THREADS) {
      int t = (t0 + TID) >> bits, lane = (t0 + TID) & ((1 << bits) - 1), j = (first + t) / 6, c = first + t - j * 6;
      float sum[1] = {0};
      if (t < items)
        for (int place = a.place_first[j] + lane, last = a.place_first[j + 1]; place < last; place += 1 << bits) {
          const float* u = m.upper + place * 36 + c;
          const float* y = out + a.block_row[a.place_block[place]] * 6;
          sum[0] += (u[0] * y[0] + u[6] * y[1]) + (u[12] * y[2] + u[18] * y[3]) + (u[24] * y[4] + u[30] * y[5]);
        }
      sum_lanes(sum, bits);
      if (t < items && lane == 0) out[first + t] = between[first + t] - sum[0];
    }
    SYNC;
  }
}
