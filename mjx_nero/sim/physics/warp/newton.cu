// Newton's method: the rows and M are in the parts before. A lane has its degrees of freedom in registers.

float a[turns], Ma[turns], smooth[turns], away[turns], g[turns], p[turns], Mp[turns];  // away = M a - smooth
UNROLLED
for (int t = 0; t < turns; ++t) {
    const int i = t * width + c;
    a[t] = i < NV ? in.qacc_warmstart.data[world * NV + i] : 0.0f;
    smooth[t] = i < NV ? in.qfrc_smooth.data[world * NV + i] : 0.0f;
}
// A lane's part of the product of two vectors.
auto product = [&](const float* u, const float* v) {
    float total = 0.0f;
    UNROLLED
    for (int t = 0; t < turns; ++t) total += half == 0 && t * width + c < NV ? u[t] * v[t] : 0.0f;
    return total;
};

multiply(a, Ma, r, aref);
int iteration = 0;
while (true) {
    forces();
    pull(g);  // then the gradient, g = M a - smooth - J' f
    UNROLLED
    for (int t = 0; t < turns; ++t) away[t] = Ma[t] - smooth[t], g[t] = away[t] - g[t];
    if (iteration >= in.iterations || scale * sqrtf(sum(product(g, g))) < limit) break;
    direction(g, p);
    float gp = product(g, p), gauss = product(p, away);
    sum_both(gp, gauss);
    if (-0.5f * scale * gp < limit) break;
    ++iteration;
    // the step: Newton's method on the slope along p, kept between steps that are too short and too long
    multiply(p, Mp, Jp, nullptr);
    const float curvature = sum(product(p, Mp));
    Part its = {};
    if (lane < parts) its = part(lane);
    float step = 1.0f, low = 0.0f, high = infinite;
    for (int k = 0; k < in.ls_iterations; ++k) {
        float d1 = 0.0f, d2 = 0.0f;
        if (lane < parts) add_slope(its, step, d1, d2);
        for (int at = lane + lanes; at < parts; at += lanes) add_slope(part(at), step, d1, d2);
        sum_both(d1, d2);
        d1 += gauss + step * curvature, d2 += curvature;
        if (fabsf(d1) <= -ls_limit * gp) break;
        if (d1 < 0.0f) low = step;
        else high = step;
        step -= over(d1, d2);
        if (!(step > low && step < high)) step = high < infinite ? 0.5f * (low + high) : 2.0f * low;
    }
    UNROLLED
    for (int t = 0; t < turns; ++t) a[t] += step * p[t], Ma[t] += step * Mp[t];
    for (int row = lane; row < n; row += lanes) r[row] += step * Jp[row];
    sync();
}
UNROLLED
for (int t = 0; t < turns; ++t) {
    const int i = t * width + c;
    if (half == 0 && i < NV) in.qacc.data[world * NV + i] = a[t], in.efc_Ma.data[world * NV + i] = Ma[t];
}
if (FORCES) {
    for (int row = lane; row < n; row += lanes) in.efc_force.data[(size_t)world * in.efc_force.shape[1] + row] = f[row];
}
if (lane == 0) in.solver_niter.data[world] = iteration;
#undef UNROLLED
