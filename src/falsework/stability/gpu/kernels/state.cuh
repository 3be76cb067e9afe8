// A state on chip.

// There is a block for every node and each of its ancestors in the elimination tree: the pattern of the inverse of
// the factor. The ancestors of a node are a chain, so the block of ancestor `i` in column `j` is number
// `column[j] + depth[j] - depth[i] - 1`. ADMM stores all of them, since it solves often; the interior point method
// stores those that the factor itself has.
struct State {
  int nodes, groups, blocks, levels;  // what acts in this state
  int storage;                        // blocks that are stored
  uint16_t* node;                     // positions that can move
  uint16_t* node_slot;                // (positions,) index in `node`
  uint16_t* level_node;               // first node of each level that is not empty
  uint16_t* group;                    // groups that act
  uint16_t* group_slot;               // (groups,) index in `group`
  uint16_t* group_node;               // (2, groups that act) node of each side, kNone where it is held
  uint16_t* depth;                    // number of ancestors of each node
  int* column;                        // first block of each node's column
  uint16_t* block_row;                // node of each block's row
  uint16_t* block_column;             // node of each block's column
  uint16_t* block_pattern;            // block of the structure's pattern, kNone where the factor is zero
  short* stored;                      // place of each block, -1 where it is not stored; null where all are
  uint16_t* place_block;              // the block in each place, column by column; not there where all are stored
  uint16_t* place_first;              // (nodes + 1,) first place of each column
  int* row;                           // first entry of each node's row
  int* row_block;                     // stored blocks of the rows, column by column; -1 - block where the factor is zero
  uint16_t* incident;                 // 2 slot + side of the groups on each node
  uint16_t *incident_first, *incident_last;

  METHOD int at(int block) const { return stored ? stored[block] : block; }

  // Block of row `i` in column `j`, -1 where `i` is not an ancestor of `j`.
  METHOD int block_of(int i, int j) const {
    int up = int(depth[j]) - int(depth[i]) - 1;
    if (up < 0) return -1;
    int b = column[j] + up;
    return block_row[b] == i ? b : -1;
  }
};

#ifdef __CUDACC__
template <class T>
struct Pair;
template <>
struct Pair<float> {
  typedef float2 type;
};
template <>
struct Pair<double> {
  typedef double2 type;
};
#endif

template <class T>
DEVICE T* take(char*& top, long long count) {
  T* result = reinterpret_cast<T*>(top);
  top += (count * sizeof(T) + 15) / 16 * 16;
  return result;
}

DEVICE int rank_of(const uint32_t* mask, int i) {
  int rank = POPCOUNT(mask[i >> 5] & ((1u << (i & 31)) - 1u));
  for (int w = 0; w < i >> 5; w++) rank += POPCOUNT(mask[w]);
  return rank;
}

// Turns flags in `slot` (kNone or not) into indices of a list, in order; every thread returns its length.
DEVICE int compact(uint16_t* slot, uint16_t* list, uint32_t* mask, int count) {
  int words = (count + 31) >> 5;
  for (int w = TID; w < words; w += THREADS) {
    uint32_t bits = 0;
    for (int i = w * 32; i < count && i < w * 32 + 32; i++) bits |= uint32_t(slot[i] != kNone) << (i & 31);
    mask[w] = bits;
  }
  SYNC;
  for (int i = TID; i < count; i += THREADS)
    if (slot[i] != kNone) {
      int rank = rank_of(mask, i);
      slot[i] = uint16_t(rank);
      list[rank] = uint16_t(i);
    }
  int total = 0;
  for (int w = 0; w < words; w++) total += POPCOUNT(mask[w]);
  SYNC;
  return total;
}

// Finds the acting parts and groups of a state, its elimination tree and the blocks of its factor.
template <bool StoreAll>
PHASE State restrict_to(const Structure& s, const uint8_t* state, char*& top) {
  State a;
  int largest = s.positions > s.groups ? s.positions : s.groups;
  uint32_t* mask = take<uint32_t>(top, (largest + 31) / 32);
  uint8_t* filled = take<uint8_t>(top, s.blocks);
  a.node = take<uint16_t>(top, s.positions);
  a.node_slot = take<uint16_t>(top, s.positions);
  a.level_node = take<uint16_t>(top, s.levels + 1);
  a.group = take<uint16_t>(top, s.groups);
  a.group_slot = take<uint16_t>(top, s.groups);

  for (int p = TID; p < s.parts; p += THREADS) {
    int j = load(s.position + p);
    if (j >= 0) a.node_slot[j] = state[p] == 1 ? 0 : kNone;
  }
  for (int g = TID; g < s.groups; g += THREADS) {
    int pa = state[load(s.group_part + g)], pb = state[load(s.group_part + s.groups + g)];
    a.group_slot[g] = pa && pb && (pa == 1 || pb == 1) ? 0 : kNone;
  }
  SYNC;
  // A block is in the pattern of S where its two parts touch and both can move; two such parts always act.
  for (int e = TID; e < s.blocks; e += THREADS) {
    bool both = a.node_slot[load(s.block_row + e)] != kNone && a.node_slot[load(s.block_column + e)] != kNone;
    filled[e] = both && load(s.block_start + e) < load(s.block_start + e + 1);
  }
  a.nodes = compact(a.node_slot, a.node, mask, s.positions);
  a.groups = compact(a.group_slot, a.group, mask, s.groups);
  for (int level = 1; level < s.levels; level++) {  // fill
    int last = load(s.column + load(s.level_start + level + 1));
    for (int e = load(s.column + load(s.level_start + level)) + TID; e < last; e += THREADS) {
      if (filled[e] || a.node_slot[load(s.block_column + e)] == kNone) continue;
      for (int u = load(s.fill_start + e); u < load(s.fill_start + e + 1); u++)
        if (filled[load(s.fill_left + u)] && filled[load(s.fill_right + u)]) {
          filled[e] = 1;
          break;
        }
    }
    SYNC;
  }
  a.group_node = take<uint16_t>(top, 2 * a.groups);
  a.depth = take<uint16_t>(top, a.nodes);
  a.column = take<int>(top, a.nodes + 1);
  a.row = take<int>(top, a.nodes + 1);
  a.incident = take<uint16_t>(top, 2 * s.groups);
  a.incident_first = take<uint16_t>(top, a.nodes);
  a.incident_last = take<uint16_t>(top, a.nodes);
  uint16_t* parent = take<uint16_t>(top, a.nodes);
  for (int i = TID; i < a.groups; i += THREADS)
    for (int side = 0; side < 2; side++) {
      int j = load(s.position + load(s.group_part + side * s.groups + a.group[i]));
      a.group_node[side * a.groups + i] = j >= 0 ? a.node_slot[j] : kNone;
    }
  for (int i = TID; i < a.nodes; i += THREADS) {
    int j = a.node[i], e = load(s.column + j), last = load(s.column + j + 1);
    while (e < last && !filled[e]) e++;
    parent[i] = e < last ? a.node_slot[load(s.block_row + e)] : kNone;
    // Groups of the whole structure without those that do not act; each list keeps its place.
    int k = load(s.incident_start + j), out = k, end = load(s.incident_start + j + 1);
    a.incident_first[i] = uint16_t(k);
    for (; k < end; k++) {
      int code = load(s.incident + k), slot = a.group_slot[code >> 1];
      if (slot != kNone) a.incident[out++] = uint16_t(2 * slot + (code & 1));
    }
    a.incident_last[i] = uint16_t(out);
  }
  a.levels = 0;
  for (int level = 0, i = 0; level < s.levels; level++) {  // the same in every thread
    int first = i, last = load(s.level_start + level + 1);
    while (i < a.nodes && a.node[i] < last) i++;
    if (i == first) continue;
    if (TID == 0) a.level_node[a.levels] = uint16_t(first);
    a.levels++;
  }
  if (TID == 0) a.level_node[a.levels] = uint16_t(a.nodes);
  SYNC;
  for (int i = TID; i < a.nodes; i += THREADS) {
    int depth = 0;
    for (int k = parent[i]; k != kNone; k = parent[k]) depth++;
    a.depth[i] = uint16_t(depth);
  }
  SYNC;
  for (int i = TID; i <= a.nodes; i += THREADS) {
    int total = 0;
    for (int k = 0; k < i; k++) total += a.depth[k];
    a.column[i] = total;
  }
  SYNC;
  a.blocks = a.column[a.nodes];
  a.block_row = take<uint16_t>(top, a.blocks);
  a.block_column = take<uint16_t>(top, a.blocks);
  a.block_pattern = take<uint16_t>(top, a.blocks);
  a.row_block = take<int>(top, a.blocks);
  for (int i = TID; i < a.nodes; i += THREADS) {
    int b = a.column[i], j = a.node[i], e = load(s.column + j), last = load(s.column + j + 1);
    for (int k = parent[i]; k != kNone; k = parent[k], b++) {
      int row = a.node[k];
      while (e < last && load(s.block_row + e) < row) e++;
      a.block_row[b] = uint16_t(k);
      a.block_column[b] = uint16_t(i);
      a.block_pattern[b] = e < last && load(s.block_row + e) == row && filled[e] ? uint16_t(e) : kNone;
    }
  }
  SYNC;
  uint16_t* count = parent;
  a.stored = nullptr;
  a.storage = a.blocks;
  if (!StoreAll) {
    a.stored = take<short>(top, a.blocks);
    for (int i = TID; i < a.nodes; i += THREADS) {
      int total = 0;
      for (int b = a.column[i]; b < a.column[i + 1]; b++) total += a.block_pattern[b] != kNone;
      count[i] = uint16_t(total);
    }
    SYNC;
    a.storage = 0;
    for (int k = 0; k < a.nodes; k++) a.storage += count[k];
    a.place_block = take<uint16_t>(top, a.storage);
    a.place_first = take<uint16_t>(top, a.nodes + 1);
    for (int i = TID; i <= a.nodes; i += THREADS) {
      int out = 0;
      for (int k = 0; k < i; k++) out += count[k];
      a.place_first[i] = uint16_t(out);
      for (int b = a.column[i]; i < a.nodes && b < a.column[i + 1]; b++) {
        bool filled_in = a.block_pattern[b] != kNone;
        if (filled_in) a.place_block[out] = uint16_t(b);
        a.stored[b] = short(filled_in ? out++ : -1);
      }
    }
    SYNC;
  }
  for (int i = TID; i < a.nodes; i += THREADS) {
    int total = 0;
    for (int j = 0; j < i; j++) {
      int b = a.block_of(i, j);
      total += b >= 0 && (StoreAll || a.block_pattern[b] != kNone);
    }
    count[i] = uint16_t(total);
  }
  SYNC;
  for (int i = TID; i <= a.nodes; i += THREADS) {
    int out = 0;
    for (int k = 0; k < i; k++) out += count[k];
    a.row[i] = out;
    for (int j = 0; j < i && i < a.nodes; j++) {
      int b = a.block_of(i, j);
      if (b < 0 || (!StoreAll && a.block_pattern[b] == kNone)) continue;
      a.row_block[out++] = a.block_pattern[b] == kNone ? -1 - b : b;
    }
  }
  SYNC;
  return a;
}
