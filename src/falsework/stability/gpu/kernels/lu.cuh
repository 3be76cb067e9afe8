// The tangent stiffness of a state and its block factor. Where contact points slide it is not symmetric, so the blocks
// above the diagonal are kept too, transposed, in the places of their mirror images: both then fill by rows alike.

struct General {
  double* diagonal;  // (nodes, 36): the matrix, then the inverse pivots
  double* lower;     // (storage, 36): L with unit diagonal
  double* upper;     // (storage, 36): transposed blocks of U, at the end with unit diagonal too
};

// Row `r` of T_left local T_right^T, or of T_left local^T T_right^T, added to `out` with a sign.
template <bool Transposed>
DEVICE void add_general_row(
    const Structure& s, const double* local, int groups, int g, int slot, int r, int left, int right, double sign,
    double (&out)[6]) {
  auto entry = [&](int i, int k) { return local[(Transposed ? k * 6 + i : i * 6 + k) * groups + slot]; };
  double v[6];
  if (r < 3) {
#pragma unroll
    for (int k = 0; k < 6; k++) v[k] = sign * entry(r, k);
  } else {
    int q = r - 3, q1 = q == 2 ? 0 : q + 1, q2 = q == 0 ? 2 : q - 1;
    double a1 = arm_of(s, left * 3 + q1, g, 0.0), a2 = arm_of(s, left * 3 + q2, g, 0.0);
#pragma unroll
    for (int k = 0; k < 6; k++) v[k] = sign * (entry(r, k) + a1 * entry(q2, k) - a2 * entry(q1, k));
  }
  double x = arm_of(s, right * 3, g, 0.0), y = arm_of(s, right * 3 + 1, g, 0.0), z = arm_of(s, right * 3 + 2, g, 0.0);
  out[0] += v[0], out[1] += v[1], out[2] += v[2];
  out[3] += v[3] + y * v[2] - z * v[1];
  out[4] += v[4] + z * v[0] - x * v[2];
  out[5] += v[5] + x * v[1] - y * v[0];
}

// Sum of the groups' local matrices, (36, groups that act), plus `shift` times the masses.
PHASE void assemble_general(const Structure& s, const State& a, double shift, const double* local, General m) {
  for (int t = TID; t < (a.nodes + 2 * a.blocks) * 6; t += THREADS) {
    int item = t / 6, r = t % 6;
    double out[6] = {};
    double* row;
    if (item < a.nodes) {
      int j = a.node[item];
      row = m.diagonal + t * 6;
      if (r < 3) {
#pragma unroll
        for (int k = 0; k < 3; k++) out[k] = r == k ? shift * load(s.mass + j) : 0.0;
      } else {
#pragma unroll
        for (int k = 0; k < 3; k++) out[3 + k] = shift * load(s.inertia + ((r - 3) * 3 + k) * s.positions + j);
      }
      for (int k = a.incident_first[item]; k < a.incident_last[item]; k++) {
        int code = a.incident[k], slot = code >> 1;
        add_general_row<false>(s, local, a.groups, a.group[slot], slot, r, code & 1, code & 1, 1.0, out);
      }
    } else {
      bool above = item >= a.nodes + a.blocks;
      int b = item - a.nodes - (above ? a.blocks : 0), place = a.at(b);
      if (place < 0) continue;
      row = (above ? m.upper : m.lower) + place * 36 + r * 6;
      int e = a.block_pattern[b], last = load(s.block_start + e + 1);
      for (int k = load(s.block_start + e); k < last; k++) {
        int g = load(s.block_group + k), slot = a.group_slot[g];
        int side = load(s.position + load(s.group_part + s.groups + g)) == load(s.block_row + e);
        if (above)
          add_general_row<true>(s, local, a.groups, g, slot, r, side, 1 - side, -1.0, out);
        else
          add_general_row<false>(s, local, a.groups, g, slot, r, side, 1 - side, -1.0, out);
      }
    }
#pragma unroll
    for (int k = 0; k < 6; k++) row[k] = out[k];
  }
  SYNC;
}

DEVICE void swap_if(bool yes, double& x, double& y) {
  double kept = x;
  x = yes ? y : x, y = yes ? kept : y;
}

// Inverse of a 6 x 6 block in place by elimination, with row pivots or with the diagonal as it comes; false where a pivot
// is less than `least` of the largest entry below it, and the block is then left as it was.
template <bool Exchange>
DEVICE bool eliminate_block(double* block, double least) {
  double m[6][6];
#pragma unroll
  for (int i = 0; i < 36; i++) m[i / 6][i % 6] = block[i];
  uint32_t swaps = 0;  // rows are exchanged one by one on the way to the pivot, so that all indices are constants
  bool good = true;
#pragma unroll
  for (int k = 0; k < 6; k++) {
    double largest = 0;
#pragma unroll
    for (int i = k + 1; i < 6; i++) {
      if (!Exchange) {
        largest = fmax(largest, fabs(m[i][k]));
        continue;
      }
      bool yes = fabs(m[i][k]) > fabs(m[k][k]);
      swaps |= uint32_t(yes) << (k * 5 + i - 1 - k * (k + 1) / 2);
#pragma unroll
      for (int j = 0; j < 6; j++) swap_if(yes, m[k][j], m[i][j]);
    }
    good = good && fabs(m[k][k]) > 1e-300 && fabs(m[k][k]) >= least * largest;
    double inverse = 1.0 / m[k][k];
    m[k][k] = 1.0;
#pragma unroll
    for (int j = 0; j < 6; j++) m[k][j] *= inverse;
#pragma unroll
    for (int i = 0; i < 6; i++) {
      if (i == k) continue;
      double share = m[i][k];
      m[i][k] = 0.0;
#pragma unroll
      for (int j = 0; j < 6; j++) m[i][j] -= share * m[k][j];
    }
  }
  if (!good) return false;
#pragma unroll
  for (int k = 4; Exchange && k >= 0; k--)
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

// Inverse of a 6 x 6 block in place; false if it is singular. Nearly all blocks need no exchange of rows, which takes as
// long as the rest.
DEVICE bool invert_block(double* block) {
  return eliminate_block<false>(block, 0.1) || eliminate_block<true>(block, 0.0);
}

// Neighbouring threads that share an item and add up what they find, where a level has fewer items than threads.
DEVICE int lanes_for(int items) {
  int lanes = 1;
  while (lanes < 8 && 2 * lanes * items <= THREADS) lanes *= 2;
  return lanes;
}
DEVICE double sum_lanes(double x, int lanes) {
#ifdef __CUDACC__
  for (int step = lanes >> 1; step; step >>= 1) x += __shfl_xor_sync(0xffffffffu, x, step);
#else
  (void)lanes;
#endif
  return x;
}

// Replaces the matrix, level by level, by its factor; false where a pivot block is singular.
PHASE bool factor_general(const State& a, General m) {
  double bad[1] = {0};
  for (int level = 0; level < a.levels; level++) {
    int node0 = a.level_node[level], nodes = a.level_node[level + 1] - node0;
    int block0 = a.column[node0], blocks = a.column[node0 + nodes] - block0;
    int rows = level ? (nodes + 2 * blocks) * 6 : 0, lanes = lanes_for(rows);
    for (int t0 = 0; t0 < rows * lanes; t0 += THREADS) {
      int t = (t0 + TID) / lanes, lane = (t0 + TID) % lanes, item = t / 6, r = t - item * 6;
      bool above = item >= nodes + blocks;
      int b = block0 + item - nodes - (above ? blocks : 0), place = t >= rows ? -1 : item < nodes ? 0 : a.at(b);
      double* row = nullptr;
      double sum[6] = {};
      if (place >= 0) {
        int j = item < nodes ? node0 + item : a.block_column[b];
        int up = item < nodes ? 0 : a.depth[j] - a.depth[a.block_row[b]];
        const double* mine = above ? m.upper : m.lower;
        const double* other = above ? m.lower : m.upper;
        row = (item < nodes ? m.diagonal + j * 36 : (above ? m.upper : m.lower) + place * 36) + r * 6;
        for (int n = a.row[j] + lane; n < a.row[j + 1]; n += lanes) {
          int right = a.row_block[n];
          if (right < 0) continue;
          int left = a.at(right + up);
          if (left < 0) continue;
          const double* x = mine + left * 36 + r * 6;
          const double* y = other + a.at(right) * 36;
#pragma unroll
          for (int k = 0; k < 6; k++) sum[k] += dot6(x, y + k * 6);
        }
      }
#pragma unroll
      for (int k = 0; k < 6; k++) sum[k] = sum_lanes(sum[k], lanes);
      if (row && lane == 0)
#pragma unroll
        for (int k = 0; k < 6; k++) row[k] -= sum[k];
    }
    SYNC;
    for (int i = TID; i < nodes; i += THREADS)
      if (!invert_block(m.diagonal + (node0 + i) * 36)) bad[0] = 1;
    SYNC;
    for (int t = TID; t < blocks * 6; t += THREADS) {
      int b = block0 + t / 6, place = a.at(b);
      if (place < 0) continue;
      double* row = m.lower + place * 36 + t % 6 * 6;
      const double* d = m.diagonal + a.block_column[b] * 36;
      double x[6];
#pragma unroll
      for (int k = 0; k < 6; k++) x[k] = row[k];
#pragma unroll
      for (int c = 0; c < 6; c++)
        row[c] = (x[0] * d[c] + x[1] * d[6 + c]) + (x[2] * d[12 + c] + x[3] * d[18 + c]) +
                 (x[4] * d[24 + c] + x[5] * d[30 + c]);
    }
    SYNC;
  }
  for (int t = TID; t < a.blocks * 6; t += THREADS) {
    int b = t / 6, place = a.at(b);
    if (place < 0) continue;
    double* row = m.upper + place * 36 + t % 6 * 6;
    const double* d = m.diagonal + a.block_column[b] * 36;
    double out[6];
#pragma unroll
    for (int c = 0; c < 6; c++) out[c] = dot6(d + c * 6, row);
#pragma unroll
    for (int c = 0; c < 6; c++) row[c] = out[c];
  }
  SYNC;
  reduce<1, 0>(bad);
  SYNC;
  return bad[0] == 0;
}

// Solves with the factor, level by level; overwrites x.
PHASE void solve_general(const State& a, General m, double* x, double* between, double* out) {
  for (int level = 1; level < a.levels; level++) {
    int first = a.level_node[level] * 6, last = a.level_node[level + 1] * 6, lanes = lanes_for(last - first);
    for (int t0 = 0; t0 < (last - first) * lanes; t0 += THREADS) {
      int t = first + (t0 + TID) / lanes, lane = (t0 + TID) % lanes, i = t / 6, r = t - i * 6;
      double sum = 0;
      if (t < last)
        for (int k = a.row[i] + lane; k < a.row[i + 1]; k += lanes) {
          int b = a.row_block[k];
          if (b >= 0) sum += dot6(m.lower + a.at(b) * 36 + r * 6, x + a.block_column[b] * 6);
        }
      sum = sum_lanes(sum, lanes);
      if (t < last && lane == 0) x[t] -= sum;
    }
    SYNC;
  }
  for (int t = TID; t < a.nodes * 6; t += THREADS) between[t] = dot6(m.diagonal + t * 6, x + t / 6 * 6);
  SYNC;
  for (int level = a.levels - 1; level >= 0; level--) {
    int first = a.level_node[level] * 6, last = a.level_node[level + 1] * 6, lanes = lanes_for(last - first);
    for (int t0 = 0; t0 < (last - first) * lanes; t0 += THREADS) {
      int t = first + (t0 + TID) / lanes, lane = (t0 + TID) % lanes, j = t / 6, c = t - j * 6;
      double sum = 0;
      if (t < last)
        for (int b = a.column[j] + lane; b < a.column[j + 1]; b += lanes) {
          int place = a.at(b);
          if (place < 0) continue;
          const double* u = m.upper + place * 36 + c;
          const double* y = out + a.block_row[b] * 6;
          sum += (u[0] * y[0] + u[6] * y[1]) + (u[12] * y[2] + u[18] * y[3]) + (u[24] * y[4] + u[30] * y[5]);
        }
      sum = sum_lanes(sum, lanes);
      if (t < last && lane == 0) out[t] = between[t] - sum;
    }
    SYNC;
  }
}
