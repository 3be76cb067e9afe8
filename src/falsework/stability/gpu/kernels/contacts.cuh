// Contact points and pairs.

DEVICE float arm_of(const Structure& s, int i, int g, float) { return load(s.arm_single + i * s.groups + g); }
DEVICE double arm_of(const Structure& s, int i, int g, double) { return load(s.arm + i * s.groups + g); }

template <class T>
struct Point {
  T axis[9], arm[3];  // axes by columns: n, t1, t2
};

DEVICE Point<float> point_of(const Structure& s, int i, int g, float) {
  Point<float> p;
  float* out = p.axis;
#pragma unroll
  for (int k = 0; k < 3; k++) {
#ifdef __CUDACC__
    float4 f = __ldg(reinterpret_cast<const float4*>(s.point_single) + (i * 3 + k) * s.groups + g);
    float v[4] = {f.x, f.y, f.z, f.w};
#else
    const float* v = s.point_single + ((i * 3 + k) * s.groups + g) * 4;
#endif
#pragma unroll
    for (int c = 0; c < 4; c++) (k * 4 + c < 9 ? out[k * 4 + c] : p.arm[k * 4 + c - 9]) = v[c];
  }
  return p;
}
DEVICE Point<double> point_of(const Structure& s, int i, int g, double) {
  Point<double> p;
#pragma unroll
  for (int k = 0; k < 9; k++) p.axis[k] = load(s.point + (i * 13 + k) * s.groups + g);
#pragma unroll
  for (int k = 0; k < 3; k++) p.arm[k] = load(s.point + (i * 13 + 9 + k) * s.groups + g);
  return p;
}
// Friction of contact points.
struct Friction {
  double common;
  const double* own;
  int groups;
  DEVICE Friction make(const Structure& s) { return {s.friction, s.own_friction, s.groups}; }
  DEVICE double of(const Friction& f, int i, int g) {
#if OWN_FRICTION
    return load(f.own + i * f.groups + g);
#else
    (void)i, (void)g;
    return f.common;
#endif
  }
};
DEVICE double friction_of(const Structure& s, int i, int g) { return Friction::of(Friction::make(s), i, g); }

DEVICE double scale_of(const Structure& s, int i, int g) { return load(s.point + (i * 13 + 12) * s.groups + g); }

// Relative velocity and rotation of part b relative to part a at the centre between them.
template <class T, class V>
DEVICE void strain_of(const int (&node)[2], const T (&arm)[6], const V* velocity, T (&out)[6]) {
#pragma unroll
  for (int k = 0; k < 6; k++) out[k] = T(0);
#pragma unroll
  for (int side = 0; side < 2; side++) {
    if (node[side] == kNone) continue;
    T sign = side ? T(1) : T(-1);
    const V* v = velocity + node[side] * 6;
    T x = arm[side * 3], y = arm[side * 3 + 1], z = arm[side * 3 + 2];
    T wx = sign * T(v[3]), wy = sign * T(v[4]), wz = sign * T(v[5]);
    out[0] += sign * T(v[0]) + wy * z - wz * y;
    out[1] += sign * T(v[1]) + wz * x - wx * z;
    out[2] += sign * T(v[2]) + wx * y - wy * x;
    out[3] += wx, out[4] += wy, out[5] += wz;
  }
}

template <class T, class V>
DEVICE void group_strain(const Structure& s, const State& a, int slot, int g, const V* velocity, T (&out)[6]) {
  int node[2] = {a.group_node[slot], a.group_node[a.groups + slot]};
  T arm[6];
#pragma unroll
  for (int k = 0; k < 6; k++) arm[k] = arm_of(s, k, g, T(0));
  strain_of(node, arm, velocity, out);
}

template <class T>
DEVICE void point_strain(const Point<T>& p, const T (&strain)[6], T& n, T& x, T& y) {
  T vx = strain[0] + strain[4] * p.arm[2] - strain[5] * p.arm[1];
  T vy = strain[1] + strain[5] * p.arm[0] - strain[3] * p.arm[2];
  T vz = strain[2] + strain[3] * p.arm[1] - strain[4] * p.arm[0];
  n = p.axis[0] * vx + p.axis[3] * vy + p.axis[6] * vz;
  x = p.axis[1] * vx + p.axis[4] * vy + p.axis[7] * vz;
  y = p.axis[2] * vx + p.axis[5] * vy + p.axis[8] * vz;
}

template <class T>
DEVICE void add_point_force(const Point<T>& p, T n, T x, T y, T (&wrench)[6]) {
  T fx = p.axis[0] * n + p.axis[1] * x + p.axis[2] * y;
  T fy = p.axis[3] * n + p.axis[4] * x + p.axis[5] * y;
  T fz = p.axis[6] * n + p.axis[7] * x + p.axis[8] * y;
  wrench[0] += fx, wrench[1] += fy, wrench[2] += fz;
  wrench[3] += p.arm[1] * fz - p.arm[2] * fy;
  wrench[4] += p.arm[2] * fx - p.arm[0] * fz;
  wrench[5] += p.arm[0] * fy - p.arm[1] * fx;
}

// Writes a force and moment about the centre of group `slot` as wrenches about the centres of its parts that move.
template <class T>
DEVICE void write_wrench(const State& a, int slot, const int (&node)[2], const T (&arm)[6], const T (&f)[6], T* wrench) {
#pragma unroll
  for (int side = 0; side < 2; side++) {
    if (node[side] == kNone) continue;
    T sign = side ? T(1) : T(-1);
    const T* d = arm + side * 3;
    T* out = wrench + side * 6 * a.groups + slot;
    out[0] = sign * f[0], out[a.groups] = sign * f[1], out[2 * a.groups] = sign * f[2];
    out[3 * a.groups] = sign * (f[3] + d[1] * f[2] - d[2] * f[1]);
    out[4 * a.groups] = sign * (f[4] + d[2] * f[0] - d[0] * f[2]);
    out[5 * a.groups] = sign * (f[5] + d[0] * f[1] - d[1] * f[0]);
  }
}

template <class T>
DEVICE void write_group_wrench(const Structure& s, const State& a, int slot, int g, const T (&f)[6], T* wrench) {
  int node[2] = {a.group_node[slot], a.group_node[a.groups + slot]};
  T arm[6];
#pragma unroll
  for (int k = 0; k < 6; k++) arm[k] = arm_of(s, k, g, T(0));
  write_wrench(a, slot, node, arm, f, wrench);
}

// Component `r` of gravity and of all group wrenches on a node.
template <class T>
DEVICE T node_wrench(const Structure& s, const State& a, int node, int r, const T* wrench) {
  T total = T(load(s.gravity + r * s.positions + a.node[node]));
  int last = a.incident_last[node];
#pragma unroll 4
  for (int k = a.incident_first[node]; k < last; k++) {
    int code = a.incident[k];
    total += wrench[((code & 1) * 6 + r) * a.groups + (code >> 1)];
  }
  return total;
}
