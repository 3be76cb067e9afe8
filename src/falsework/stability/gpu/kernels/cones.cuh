// Friction cone.

template <class T>
struct Cone {
  T mu, facet, facet_scale, edge, edge_scale;
  DEVICE Cone make(double friction) {
    double k = friction * 0.92387953251128674;
    return {T(friction), T(k), T(1 / (1 + k * k)), T(friction * 0.38268343236508977), T(1 / (1 + friction * friction))};
  }
};

template <class T>
DEVICE void project(const Cone<T>& cone, T& n, T& x, T& y) {
#if QUADRATIC
  T t = sqrt(x * x + y * y);
  if (n >= T(0) && t <= cone.mu * n) return;
  T s = (n + cone.mu * t) * cone.edge_scale;
  if (!(s > T(0))) {
    n = x = y = T(0);
    return;
  }
  T f = cone.mu * s / t;
  n = s, x *= f, y *= f;
#else
  const T c = T(0.92387953251128674), s = T(0.38268343236508977);
  T ax = fabs(x), ay = fabs(y);
  T u = fmax(ax, ay), v = fmin(ax, ay);
  T p = u * c + v * s, q = v * c - u * s;  // along the normal of the facet, and along the facet
  if (n >= T(0) && p <= cone.facet * n) return;
  T t = (n + cone.facet * p) * cone.facet_scale;
  T reach = cone.edge * t;
  if (!(t > T(0) && fabs(q) <= reach)) {
    t = (n + cone.facet * p + cone.edge * fabs(q)) * cone.edge_scale;
    t = t <= T(0) ? T(0) : t;  // keeps NaN
    q = copysign(cone.edge * t, q);
  }
  p = cone.facet * t;
  u = p * c - q * s, v = p * s + q * c;
  bool swap = ay > ax;
  n = t;
  x = copysign(swap ? v : u, x);
  y = copysign(swap ? u : v, y);
#endif
}

// Largest power of a force of the cone with normal component 1.
template <class T>
DEVICE T support(T mu, T n, T x, T y) {
#if QUADRATIC
  return n + mu * sqrt(x * x + y * y);
#else
  T ax = fabs(x), ay = fabs(y);
  return n + mu * fmax(fmax(ax, ay), T(0.70710678118654752) * (ax + ay));
#endif
}

DEVICE double ray_x(int k) {
  const double d = 0.70710678118654752;
  return k == 0 ? 1.0 : k == 4 ? -1.0 : (k == 2 || k == 6) ? 0.0 : (k == 1 || k == 7) ? d : -d;
}
DEVICE double ray_y(int k) { return ray_x((k + 6) & 7); }
