// The interior point method in float64: Mehrotra's predictor and corrector on
//   min 1/2 r.M r - g.r  over velocities r with G^T r in the dual cone.

struct Multipliers {
  double x[kRays], s[kRays];
};

DEVICE Multipliers load_point(const double* weights, const double* slacks, const State& a, int i, int slot) {
  Multipliers p;
#pragma unroll
  for (int k = 0; k < kRays; k++) {
    p.x[k] = weights[(i * kRays + k) * a.groups + slot];
    p.s[k] = slacks[(i * kRays + k) * a.groups + slot];
  }
  return p;
}

#if QUADRATIC
// Nesterov-Todd scaling point in coordinates in which the cone is its own dual.
struct Scaling {
  double v0, v1, v2, scale, det_s;
  DEVICE Scaling make(const Multipliers& p) {
    double det_x = p.x[0] * p.x[0] - p.x[1] * p.x[1] - p.x[2] * p.x[2];
    double det_s = p.s[0] * p.s[0] - p.s[1] * p.s[1] - p.s[2] * p.s[2];
    double fx = 1 / sqrt(det_x), fs = 1 / sqrt(det_s);
    double both = fx * fs * (p.x[0] * p.s[0] + p.x[1] * p.s[1] + p.x[2] * p.s[2]);
    double f = 1 / sqrt(2 * (1 + both));
    return {f * (fx * p.x[0] + fs * p.s[0]), f * (fx * p.x[1] - fs * p.s[1]), f * (fx * p.x[2] - fs * p.s[2]),
            sqrt(det_x / det_s), det_s};
  }
};

// Largest step along `d` that stays in the cone.
DEVICE double to_boundary(const double (&x)[3], const double (&d)[3]) {
  double a = d[0] * d[0] - d[1] * d[1] - d[2] * d[2];
  double b = x[0] * d[0] - x[1] * d[1] - x[2] * d[2];
  double c = x[0] * x[0] - x[1] * x[1] - x[2] * x[2];
  double reach = d[0] < 0 ? -x[0] / d[0] : kHuge;
  double discriminant = b * b - a * c;
  if (discriminant > 0) {
    double q = -(b + copysign(sqrt(discriminant), b));
    double t = a != 0 ? q / a : -1.0;
    if (t > 0) reach = fmin(reach, t);
    t = q != 0 ? c / q : -1.0;
    if (t > 0) reach = fmin(reach, t);
  }
  return reach;
}
#endif

// Steps of a contact point towards y = G^T (r + dr), and the largest feasible step. `predicted` is y of the predictor,
// null in the predictor itself.
DEVICE double point_step(
    double mu, const Multipliers& p, double target, const double* predicted, double n, double x, double y,
    double (&dx)[kRays], double (&ds)[kRays]) {
  double reach = kHuge;
#if QUADRATIC
  (void)predicted;
  Scaling w = Scaling::make(p);
  n /= mu;
  double along = 2 * (w.v0 * n + w.v1 * x + w.v2 * y), t = target / w.det_s;
  dx[0] = t * p.s[0] - w.scale * (along * w.v0 - n);
  dx[1] = -t * p.s[1] - w.scale * (along * w.v1 + x);
  dx[2] = -t * p.s[2] - w.scale * (along * w.v2 + y);
  ds[0] = n - p.s[0], ds[1] = x - p.s[1], ds[2] = y - p.s[2];
  reach = fmin(to_boundary(p.x, dx), to_boundary(p.s, ds));
#else
#pragma unroll
  for (int k = 0; k < 8; k++) {
    double inverse = 1 / p.s[k];
    double at = n + mu * (ray_x(k) * x + ray_y(k) * y), second = 0;
    if (predicted) {
      double before = predicted[0] + mu * (ray_x(k) * predicted[1] + ray_y(k) * predicted[2]);
      second = -p.x[k] * before * inverse * (before - p.s[k]);
    }
    ds[k] = at - p.s[k];
    dx[k] = (target - second - p.x[k] * at) * inverse;
    if (ds[k] < 0) reach = fmin(reach, -p.s[k] / ds[k]);
    if (dx[k] < 0) reach = fmin(reach, -p.x[k] / dx[k]);
  }
#endif
  return reach;
}

// Weight matrix (packed 00 01 02 11 12 22) and target force of a contact point.
DEVICE void point_system(
    double mu, const Multipliers& p, double target, const double* predicted, double (&w)[6], double (&b)[3]) {
#if QUADRATIC
  (void)predicted;
  Scaling v = Scaling::make(p);
  w[0] = v.scale * (2 * v.v0 * v.v0 - 1) / (mu * mu);
  w[1] = v.scale * 2 * v.v0 * v.v1 / mu;
  w[2] = v.scale * 2 * v.v0 * v.v2 / mu;
  w[3] = v.scale * (2 * v.v1 * v.v1 + 1);
  w[4] = v.scale * 2 * v.v1 * v.v2;
  w[5] = v.scale * (2 * v.v2 * v.v2 + 1);
  double t = target / v.det_s;
  b[0] = (p.x[0] + t * p.s[0]) / mu;
  b[1] = p.x[1] - t * p.s[1];
  b[2] = p.x[2] - t * p.s[2];
#else
  for (int k = 0; k < 6; k++) w[k] = 0;
  b[0] = b[1] = b[2] = 0;
#pragma unroll
  for (int k = 0; k < 8; k++) {
    double inverse = 1 / p.s[k];
    double ratio = p.x[k] * inverse, rx = mu * ray_x(k), ry = mu * ray_y(k), second = 0;
    if (predicted) {
      double before = predicted[0] + rx * predicted[1] + ry * predicted[2];
      second = -ratio * before * (before - p.s[k]);
    }
    w[0] += ratio, w[1] += ratio * rx, w[2] += ratio * ry;
    w[3] += ratio * rx * rx, w[4] += ratio * rx * ry, w[5] += ratio * ry * ry;
    double force = p.x[k] + (target - second) * inverse;
    b[0] += force, b[1] += force * rx, b[2] += force * ry;
  }
#endif
}
