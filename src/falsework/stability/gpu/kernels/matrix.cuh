// S = shift M + sum of the groups' local matrices, and solves with it. All by 6 x 6 blocks, row by row.

template <class T>
struct Matrix {
  T* diagonal;  // (nodes, 36): S, then the inverse of the factor
  T* lower;     // (storage, 36)
};

// Index of entry (i, k) of a symmetric matrix in its packed lower triangle.
DEVICE int packed(int i, int k) { return i >= k ? i * (i + 1) / 2 + k : k * (k + 1) / 2 + i; }

DEVICE float local_of(const Structure& s, const State&, const float* local, int i, int g, int) {
  return load(local + i * s.groups + g);
}
DEVICE double local_of(const Structure&, const State& a, const double* local, int i, int, int slot) {
  return local[i * a.groups + slot];
}

// Row `r` of T_left local T_right^T, added to `out` with a sign.
template <class T>
DEVICE void add_local_row(
    const Structure& s, const State& a, const T* local, int g, int slot, int r, int left, int right, T sign,
    T (&out)[6]) {
  T v[6];
  if (r < 3) {
#pragma unroll
    for (int k = 0; k < 6; k++) v[k] = sign * local_of(s, a, local, packed(r, k), g, slot);
  } else {
    int q = r - 3, q1 = q == 2 ? 0 : q + 1, q2 = q == 0 ? 2 : q - 1;
    T a1 = arm_of(s, left * 3 + q1, g, T(0)), a2 = arm_of(s, left * 3 + q2, g, T(0));
#pragma unroll
    for (int k = 0; k < 6; k++)
      v[k] = sign * (local_of(s, a, local, packed(r, k), g, slot) + a1 * local_of(s, a, local, packed(q2, k), g, slot) -
                     a2 * local_of(s, a, local, packed(q1, k), g, slot));
  }
  T x = arm_of(s, right * 3, g, T(0)), y = arm_of(s, right * 3 + 1, g, T(0)), z = arm_of(s, right * 3 + 2, g, T(0));
  out[0] += v[0], out[1] += v[1], out[2] += v[2];
  out[3] += v[3] + y * v[2] - z * v[1];
  out[4] += v[4] + z * v[0] - x * v[2];
  out[5] += v[5] + x * v[1] - y * v[0];
}

template <class T>
PHASE void assemble(const Structure& s, const State& a, double shift, const T* local, Matrix<T> m) {
  for (int t = TID; t < (a.nodes + a.blocks) * 6; t += THREADS) {
    int item = t / 6, r = t % 6;
    int place = item < a.nodes ? item : a.at(item - a.nodes);
    if (place < 0) continue;
    T out[6] = {};
    if (item < a.nodes) {
      int j = a.node[item];
      if (r < 3) {
#pragma unroll
        for (int k = 0; k < 3; k++) out[k] = r == k ? T(shift * load(s.mass + j)) : T(0);
      } else {
#pragma unroll
        for (int k = 0; k < 3; k++) out[3 + k] = T(shift * load(s.inertia + ((r - 3) * 3 + k) * s.positions + j));
      }
      for (int k = a.incident_first[item]; k < a.incident_last[item]; k++) {
        int code = a.incident[k], slot = code >> 1;
        add_local_row(s, a, local, int(a.group[slot]), slot, r, code & 1, code & 1, T(1), out);
      }
    } else {
      int e = a.block_pattern[item - a.nodes];
      int k = e == kNone ? 0 : load(s.block_start + e), last = e == kNone ? 0 : load(s.block_start + e + 1);
      for (; k < last; k++) {
        int g = load(s.block_group + k);
        int side = load(s.position + load(s.group_part + s.groups + g)) == load(s.block_row + e);
        add_local_row(s, a, local, g, int(a.group_slot[g]), r, side, 1 - side, T(-1), out);
      }
    }
    T* row = (item < a.nodes ? m.diagonal : m.lower) + place * 36 + r * 6;
#pragma unroll
    for (int k = 0; k < 6; k++) row[k] = out[k];
  }
  SYNC;
}

// Replaces a 6 x 6 block by the inverse of its Cholesky factor (lower triangle); false where a pivot is not positive.
template <class T>
DEVICE bool invert_factor(T* block) {
  T c[21];
#pragma unroll
  for (int i = 0; i < 6; i++)
#pragma unroll
    for (int j = 0; j <= i; j++) c[i * (i + 1) / 2 + j] = block[i * 6 + j];
  bool good = true;
#pragma unroll
  for (int j = 0; j < 6; j++) {
    T pivot = c[j * (j + 1) / 2 + j];
    good = good && pivot > T(0);
#ifdef __CUDACC__
    T inverse = rsqrt(pivot);
#else
    T inverse = T(1) / sqrt(pivot);
#endif
    c[j * (j + 1) / 2 + j] = inverse;  // the diagonal holds 1 / C_jj
#pragma unroll
    for (int i = j + 1; i < 6; i++) c[i * (i + 1) / 2 + j] *= inverse;
#pragma unroll
    for (int i = j + 1; i < 6; i++)
#pragma unroll
      for (int k = j + 1; k <= i; k++) c[i * (i + 1) / 2 + k] -= c[i * (i + 1) / 2 + j] * c[k * (k + 1) / 2 + j];
  }
#pragma unroll
  for (int j = 0; j < 6; j++)
#pragma unroll
    for (int i = j + 1; i < 6; i++) {
      T total = T(0);
#pragma unroll
      for (int k = j; k < i; k++) total += c[i * (i + 1) / 2 + k] * c[k * (k + 1) / 2 + j];
      c[i * (i + 1) / 2 + j] = -total * c[i * (i + 1) / 2 + i];
    }
#pragma unroll
  for (int i = 0; i < 6; i++)
#pragma unroll
    for (int j = 0; j <= i; j++) block[i * 6 + j] = c[i * (i + 1) / 2 + j];
  return good;
}

template <class T>
DEVICE T dot6(const T* a, const T* b) {
#ifdef __CUDACC__
  using Two = typename Pair<T>::type;  // rows are 24 or 48 bytes
  const Two* p = reinterpret_cast<const Two*>(a);
  const Two* q = reinterpret_cast<const Two*>(b);
  Two a0 = p[0], a1 = p[1], a2 = p[2], b0 = q[0], b1 = q[1], b2 = q[2];
  return (a0.x * b0.x + a0.y * b0.y) + (a1.x * b1.x + a1.y * b1.y) + (a2.x * b2.x + a2.y * b2.y);
#else
  return (a[0] * b[0] + a[1] * b[1]) + (a[2] * b[2] + a[3] * b[3]) + (a[4] * b[4] + a[5] * b[5]);
#endif
}

// Replaces S, level by level, by its Cholesky factor C with inverted diagonal blocks; false where a pivot is not
// positive. Then multiplies by them to make L with unit diagonal.
template <class T>
PHASE bool factor(const State& a, Matrix<T> m) {
  double bad[1] = {0};
  for (int level = 0; level < a.levels; level++) {
    int node0 = a.level_node[level], nodes = a.level_node[level + 1] - node0;
    int block0 = a.column[node0], blocks = a.column[node0 + nodes] - block0;
    int rows = level ? (nodes + blocks) * 6 : 0, bits = lane_bits(rows);
    for (int t0 = 0; t0 < rows << bits; t0 += THREADS) {
      int t = (t0 + TID) >> bits, lane = (t0 + TID) & ((1 << bits) - 1), item = t / 6, r = t - item * 6;
      int b = block0 + item - nodes;
      bool in = t < rows && (item < nodes || a.block_pattern[b] != kNone);
      T* row = nullptr;
      T sum[6] = {};
      if (in) {
        int j = item < nodes ? node0 + item : a.block_column[b];
        int up = item < nodes ? 0 : a.depth[j] - a.depth[a.block_row[b]];
        row = (item < nodes ? m.diagonal + j * 36 : m.lower + a.at(b) * 36) + r * 6;
        for (int n = a.row[j] + lane, last = a.row[j + 1]; n < last; n += 1 << bits) {
          int right = a.row_block[n];
          if (right < 0) continue;
          int left = a.at(right + up);
          if (left < 0) continue;
          const T* x = m.lower + left * 36 + r * 6;
          const T* y = m.lower + a.at(right) * 36;
#pragma unroll
          for (int k = 0; k < 6; k++) sum[k] += dot6(x, y + k * 6);
        }
      }
      sum_lanes(sum, bits);
      if (in && lane == 0)
#pragma unroll
        for (int k = 0; k < 6; k++) row[k] -= sum[k];
    }
    SYNC;
    for (int i = TID; i < nodes; i += THREADS)
      if (!invert_factor(m.diagonal + (node0 + i) * 36)) bad[0] = 1;
    SYNC;
    for (int t = TID; t < blocks * 6; t += THREADS) {
      int b = block0 + t / 6;
      if (a.block_pattern[b] == kNone) continue;
      T* row = m.lower + a.at(b) * 36 + t % 6 * 6;
      const T* c = m.diagonal + a.block_column[b] * 36;
      T x[6];
#pragma unroll
      for (int k = 0; k < 6; k++) x[k] = row[k];
#pragma unroll
      for (int k = 0; k < 6; k++) {
        T total = T(0);
#pragma unroll
        for (int i = 0; i <= k; i++) total += x[i] * c[k * 6 + i];
        row[k] = total;
      }
    }
    SYNC;
  }
  for (int t = TID; t < a.blocks * 6; t += THREADS) {
    int b = t / 6;
    if (a.block_pattern[b] == kNone) continue;
    T* row = m.lower + a.at(b) * 36 + t % 6 * 6;
    const T* c = m.diagonal + a.block_column[b] * 36;
    T x[6];
#pragma unroll
    for (int k = 0; k < 6; k++) x[k] = row[k];
#pragma unroll
    for (int i = 0; i < 6; i++) {
      T total = T(0);
#pragma unroll
      for (int k = i; k < 6; k++) total += x[k] * c[k * 6 + i];
      row[i] = total;
    }
  }
  SYNC;
  reduce<1, 0>(bad);
  SYNC;
  return bad[0] == 0;
}

// From L and the inverse of the diagonal of C to W = L^-1 and then to V = C^-1, so that S^-1 = V^T V.
template <class T>
PHASE void invert(const State& a, Matrix<T> m) {
  // Row i of W in place of row i of L: a block of L is needed for the columns up to its own, so columns ascend and
  // nothing is written before all threads have read.
  for (int level = 1; level < a.levels; level++) {
    int first = a.row[a.level_node[level]], items = (a.row[a.level_node[level + 1]] - first) * 6;
    for (int t0 = 0; t0 < items; t0 += THREADS) {
      int t = t0 + TID;
      T out[6];
      T* row = nullptr;
      if (t < items) {
        int b = a.row_block[first + t / 6], r = t % 6;
        b = b < 0 ? -1 - b : b;
        row = m.lower + b * 36 + r * 6;
        int j = a.block_column[b], depth = a.depth[a.block_row[b]];
#pragma unroll
        for (int k = 0; k < 6; k++) out[k] = -row[k];
        for (int c = a.column[j]; c < b; c++) {
          int k = a.block_row[c], left = a.column[k] + a.depth[k] - depth - 1;
          if (a.block_pattern[left] == kNone) continue;
          const T* x = m.lower + left * 36 + r * 6;
          const T* y = m.lower + c * 36;
#pragma unroll
          for (int i = 0; i < 6; i++) {
            T value = x[i];
#pragma unroll
            for (int n = 0; n < 6; n++) out[n] -= value * y[i * 6 + n];
          }
        }
      }
      SYNC;
      if (row)
#pragma unroll
        for (int k = 0; k < 6; k++) row[k] = out[k];
    }
    SYNC;
  }
  for (int t = TID; t < a.blocks * 6; t += THREADS) {
    int b = t / 6;
    T* column = m.lower + b * 36 + t % 6;
    const T* c = m.diagonal + a.block_row[b] * 36;
    T x[6];
#pragma unroll
    for (int k = 0; k < 6; k++) x[k] = column[k * 6];
#pragma unroll
    for (int i = 0; i < 6; i++) {
      T total = T(0);
#pragma unroll
      for (int k = 0; k <= i; k++) total += c[i * 6 + k] * x[k];
      column[i * 6] = total;
    }
  }
  for (int t = TID; t < a.nodes * 36; t += THREADS)
    if (t / 6 % 6 < t % 6) m.diagonal[t] = T(0);
  SYNC;
}

// Solves S out = V^T V x; `between` holds V x.
template <class T>
DEVICE void solve(const State& a, Matrix<T> m, const T* x, T* between, T* out) {
  for (int t = TID; t < a.nodes * 6; t += THREADS) {
    int i = t / 6, r = t - i * 6, end = a.row[i + 1];
    T total = dot6(m.diagonal + t * 6, x + i * 6);
#pragma unroll 4
    for (int k = a.row[i]; k < end; k++) {
      int b = a.row_block[k];
      b = b < 0 ? -1 - b : b;
      total += dot6(m.lower + b * 36 + r * 6, x + a.block_column[b] * 6);
    }
    between[t] = total;
  }
  SYNC;
  for (int t = TID; t < a.nodes * 6; t += THREADS) {
    int j = t / 6, c = t - j * 6, end = a.column[j + 1];
    const T* l = m.diagonal + j * 36 + c;
    const T* y = between + j * 6;
    T total = (l[0] * y[0] + l[6] * y[1]) + (l[12] * y[2] + l[18] * y[3]) + (l[24] * y[4] + l[30] * y[5]);
#pragma unroll 4
    for (int b = a.column[j]; b < end; b++) {
      l = m.lower + b * 36 + c;
      y = between + a.block_row[b] * 6;
      total += (l[0] * y[0] + l[6] * y[1]) + (l[12] * y[2] + l[18] * y[3]) + (l[24] * y[4] + l[30] * y[5]);
    }
    out[t] = total;
  }
  SYNC;
}

// Solves S out = x with L and the inverse of the diagonal of C, level by level; overwrites x.
template <class T>
DEVICE void solve_by_levels(const State& a, Matrix<T> m, T* x, T* between, T* out) {
  for (int level = 1; level < a.levels; level++) {
    int first = a.level_node[level] * 6, items = a.level_node[level + 1] * 6 - first, bits = lane_bits(items);
    for (int t0 = 0; t0 < items << bits; t0 += THREADS) {
      int t = (t0 + TID) >> bits, lane = (t0 + TID) & ((1 << bits) - 1), i = (first + t) / 6, r = first + t - i * 6;
      T sum[1] = {T(0)};
      if (t < items)
        for (int k = a.row[i] + lane, last = a.row[i + 1]; k < last; k += 1 << bits) {
          int b = a.row_block[k];
          if (b >= 0) sum[0] += dot6(m.lower + a.at(b) * 36 + r * 6, x + a.block_column[b] * 6);
        }
      sum_lanes(sum, bits);
      if (t < items && lane == 0) x[first + t] -= sum[0];
    }
    SYNC;
  }
  for (int t = TID; t < a.nodes * 6; t += THREADS) {
    int i = t / 6, r = t - i * 6;
    T total = T(0);
    for (int k = 0; k <= r; k++) total += m.diagonal[t * 6 + k] * x[i * 6 + k];
    between[t] = total;
  }
  SYNC;
  for (int level = a.levels - 1; level >= 0; level--) {
    int first = a.level_node[level] * 6, items = a.level_node[level + 1] * 6 - first, bits = lane_bits(items);
    for (int t0 = 0; t0 < items << bits; t0 += THREADS) {
      int t = (t0 + TID) >> bits, lane = (t0 + TID) & ((1 << bits) - 1), j = (first + t) / 6, c = first + t - j * 6;
      T sum[1] = {T(0)};
      if (t < items) {
        if (lane == 0)
          for (int k = c; k < 6; k++) sum[0] += m.diagonal[j * 36 + k * 6 + c] * between[j * 6 + k];
        for (int b = a.column[j] + lane, last = a.column[j + 1]; b < last; b += 1 << bits) {
          int place = a.at(b);
          if (place < 0) continue;
          const T* l = m.lower + place * 36 + c;
          const T* y = out + a.block_row[b] * 6;
          sum[0] -= (l[0] * y[0] + l[6] * y[1]) + (l[12] * y[2] + l[18] * y[3]) + (l[24] * y[4] + l[30] * y[5]);
        }
      }
      sum_lanes(sum, bits);
      if (t < items && lane == 0) out[first + t] = sum[0];
    }
    SYNC;
  }
}
