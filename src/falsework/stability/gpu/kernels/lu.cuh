// The tangent stiffness of a state and its block factor, in float32: wrenches decide whether a state is at rest, in
// float64, so the precision of a step matters only for how many are needed, and there are as many as in float64. Where
// contact points slide the matrix is not symmetric, so the blocks above the diagonal are kept too, transposed, in the
// places of their mirror images: both then fill by rows alike.

struct General {
  float* diagonal;         // (nodes, 36): the matrix, then the inverse pivots
  float* lower;            // (storage, 36): L with unit diagonal
  float* upper;            // (storage, 36): transposed blocks of U, at the end with unit diagonal too
  uint16_t* place_row;     // (storage,) node of each place's row
  uint16_t* place_column;  // (storage,) node of its column
  int* product_first;      // (nodes + storage + 1,) first product of each diagonal block, then of each place
  uint32_t* product;       // places left and right of the blocks whose product is taken from a block
};

// Lists the products of a factor, once for all factors of a state: a thread that looks its operands up in the indices
// of the state waits for one memory access after another.
PHASE void list_products(const State& a, General m) {
  int* count = reinterpret_cast<int*>(m.diagonal);  // not in use yet
  for (int pass = 0; pass < 2; pass++) {
    for (int t = TID; t < a.nodes + a.storage; t += THREADS) {
      int j = t, up = 0;
      if (t >= a.nodes) {
        int place = t - a.nodes, b = a.place_block[place];
        j = a.block_column[b], up = b - a.column[j] + 1;
        m.place_row[place] = a.block_row[b], m.place_column[place] = uint16_t(j);
      }
      int out = pass ? m.product_first[t] : 0;
      for (int n = a.row[j]; n < a.row[j + 1]; n++) {
        int right = a.row_block[n], left = a.stored[right + up];
        if (left < 0) continue;
        if (pass) m.product[out] = uint32_t(left) << 16 | uint32_t(a.stored[right]);
        out++;
      }
      if (!pass) count[t] = out;
    }
    SYNC;
    if (pass) break;
    for (int t = TID; t <= a.nodes + a.storage; t += THREADS) {
      int out = 0;
#pragma unroll 8
      for (int k = 0; k < t; k++) out += count[k];
      m.product_first[t] = out;
    }
    SYNC;
  }
}

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
  for (int t = TID; t < (a.nodes + a.storage) * 6; t += THREADS) {
    int item = t / 6, r = t % 6;
    float out[6] = {};
    if (item < a.nodes) {
      int j = a.node[item];
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
      store_row(m.diagonal + t * 6, out);
    } else {
      float above[6] = {};
      int place = item - a.nodes, e = a.block_pattern[a.place_block[place]], last = load(s.block_start + e + 1);
      for (int k = load(s.block_start + e); k < last; k++) {
        int g = load(s.block_group + k), slot = a.group_slot[g];
        int side = load(s.position + load(s.group_part + s.groups + g)) == load(s.block_row + e);
        add_general_row<false>(s, local + slot * 36, g, r, side, 1 - side, -1.0f, out);
        add_general_row<true>(s, local + slot * 36, g, r, side, 1 - side, -1.0f, above);
      }
      store_row(m.lower + place * 36 + r * 6, out);
      store_row(m.upper + place * 36 + r * 6, above);
    }
  }
  SYNC;
}

DEVICE void swap_if(bool yes, float& x, float& y) {
  float kept = x;
  x = yes ? y : x, y = yes ? kept : y;
}

// Inverse of a 6 x 6 block in place by elimination with row pivoting; false if it is singular (then unchanged).
DEVICE bool eliminate_block(float* block) {
  float m[6][6];
#pragma unroll
  for (int i = 0; i < 36; i++) m[i / 6][i % 6] = block[i];
  uint32_t swaps = 0;  // rows are exchanged one by one up to the pivot, so that all indices are constants
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

// Inverts some 6 x 6 blocks in place; false where one is singular. Nearly all need no row exchange. A thread takes a
// whole block, since six that share one wait longer for each other's pivots than for their own arithmetic.
DEVICE bool invert_blocks(float* blocks, int count) {
  bool fine = true;
  for (int b = TID; b < count; b += THREADS) {
    float* block = blocks + b * 36;
    float m[6][6];
#pragma unroll
    for (int i = 0; i < 6; i++) load_row(block + i * 6, m[i]);
    bool good = true;
#pragma unroll
    for (int k = 0; k < 6; k++) {
      float pivot = m[k][k], inverse = RECIPROCAL(pivot);
      good = good && fabs(pivot) > 1e-30f;
      m[k][k] = 1.0f;
#pragma unroll
      for (int j = 0; j < 6; j++) m[k][j] *= inverse;
#pragma unroll
      for (int i = 0; i < 6; i++) {
        if (i == k) continue;
        float share = m[i][k];
        good = good && (i < k || fabs(pivot) >= 0.1f * fabs(share));
        m[i][k] = 0.0f;
#pragma unroll
        for (int j = 0; j < 6; j++) m[i][j] -= share * m[k][j];
      }
    }
    if (good)
#pragma unroll
      for (int i = 0; i < 6; i++) store_row(block + i * 6, m[i]);
    else
      fine = eliminate_block(block) && fine;
  }
  return fine;
}

// Replaces the matrix, level by level, by its factor, and x by the forward substitution; false where a pivot
// block is singular.
PHASE bool factor_general(const State& a, General m, float* x) {
  bool fine = true;
  for (int level = 0; level < a.levels; level++) {
    int node0 = a.level_node[level], nodes = a.level_node[level + 1] - node0;
    int place0 = a.place_first[node0], blocks = a.place_first[node0 + nodes] - place0;
    int of_matrix = (nodes + 2 * blocks) * 6, rows = level ? of_matrix + nodes : 0, bits = lane_bits(rows);
    for (int t0 = 0; t0 < rows << bits; t0 += THREADS) {
      int t = (t0 + TID) >> bits, lane = (t0 + TID) & ((1 << bits) - 1), item = t / 6, r = t - item * 6;
      bool right_side = t >= of_matrix, above = item >= nodes + blocks && !right_side;
      float* row = nullptr;
      float sum[6] = {};
      if (t < rows) {
        int place = place0 + item - nodes - (above ? blocks : 0), target = a.nodes + place;
        const float* mine = (above ? m.upper : m.lower) + r * 6;
        const float* other = above || right_side ? m.lower : m.upper;
        if (right_side)
          target = node0 + t - of_matrix, row = x + target * 6;
        else if (item < nodes)
          target = node0 + item, row = m.diagonal + target * 36 + r * 6;
        else
          row = (above ? m.upper : m.lower) + place * 36 + r * 6;
        for (int n = m.product_first[target] + lane, last = m.product_first[target + 1]; n < last; n += 1 << bits) {
          int pair = int(m.product[n]), left = pair >> 16, right = pair & 0xffff;
          float v[6];
          load_row(right_side ? x + m.place_column[right] * 6 : mine + left * 36, v);
          add_products(v, other + right * 36, sum);
        }
      }
      sum_lanes(sum, bits);
      if (t < rows && lane == 0) {
        float v[6];
        load_row(row, v);
#pragma unroll
        for (int k = 0; k < 6; k++) v[k] -= sum[k];
        store_row(row, v);
      }
    }
    SYNC;
    fine = invert_blocks(m.diagonal + node0 * 36, nodes) && fine;
    SYNC;
    for (int t = TID; t < blocks * 6; t += THREADS) {
      int place = place0 + t / 6;
      float* row = m.lower + place * 36 + t % 6 * 6;
      const float* d = m.diagonal + m.place_column[place] * 36;
      float v[6], out[6] = {};
      load_row(row, v);
#pragma unroll
      for (int k = 0; k < 6; k++) {
        float y[6];
        load_row(d + k * 6, y);
#pragma unroll
        for (int c = 0; c < 6; c++) out[c] += v[k] * y[c];
      }
      store_row(row, out);
    }
    SYNC;
  }
  for (int t = TID; t < a.storage * 6; t += THREADS) {
    float* row = m.upper + t * 6;
    float v[6], out[6] = {};
    load_row(row, v);
    add_products(v, m.diagonal + m.place_column[t / 6] * 36, out);
    store_row(row, out);
  }
  return ALL(fine);
}

// Solves with the upper factor, level by level, for the x that `factor_general` leaves.
PHASE void solve_general(const State& a, General m, const float* x, float* between, float* out) {
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
          const float* y = out + m.place_row[place] * 6;
          sum[0] += (u[0] * y[0] + u[6] * y[1]) + (u[12] * y[2] + u[18] * y[3]) + (u[24] * y[4] + u[30] * y[5]);
        }
      sum_lanes(sum, bits);
      if (t < items && lane == 0) out[first + t] = between[first + t] - sum[0];
    }
    SYNC;
  }
}
