// One environment: a <- argmin  1/2 (a - smooth)' M (a - smooth) + s(J a - aref).
// NV degrees of freedom, at most NJ rows, n of them in use; r = J a - aref, f = -s'(r), p the search direction.
// The rows of a contact with an elliptic cone follow one another; the first, the normal's, stands for all of them.
//
// The body of a function of (tid, problem) that newton.py compiles, after the constants NV, NJ, SIZE, ELLIPTIC and FORCES.

const auto& in = problem;
#if defined(__CUDA_ARCH__)
constexpr int lanes = 32;
const int lane = threadIdx.x % lanes;
__shared__ float s[SIZE];
auto sync = [] { __syncwarp(); };
auto sum = [](float x) {
    for (int offset = 16; offset; offset >>= 1) x += __shfl_xor_sync(0xffffffff, x, offset);
    return x;
};
#else
constexpr int lanes = 1;
const int lane = 0;
float s[SIZE];
auto sync = [] {};
auto sum = [](float x) { return x; };
#endif
const int world = tid / lanes, n = in.nefc.data[world] < NJ ? in.nefc.data[world] : NJ;
const int equalities = in.ne.data[world], bilateral = equalities + in.nf.data[world];
const float* efc_J_row = in.efc_J.data + (size_t)world * in.efc_J.shape[1] * in.efc_J.shape[2];
const float* aref = in.efc_aref.data + (size_t)world * in.efc_aref.shape[1];
const float* loss = in.efc_frictionloss.data + (size_t)world * in.efc_frictionloss.shape[1];
const float* packed = in.M.data + (size_t)world * in.M.shape[1];
const float* smooth = in.qfrc_smooth.data + world * NV;
const float shrink = in.impratio_invsqrt.data[world % in.impratio_invsqrt.shape[0]];
const float limit = in.tolerance.data[world % in.tolerance.shape[0]];
const float ls_limit = in.ls_tolerance.data[world % in.ls_tolerance.shape[0]];

float *M = s, *H = M + NV * NV, *J = H + NV * NV;
float *a = J + NJ * NV, *p = a + NV, *g = p + NV, *Ma = g + NV, *Mp = Ma + NV, *r = Mp + NV, *Jp = r + NJ;
float* D = Jp + NJ;  // a row's stiffness ...
float* mu = D + NJ;  // ... and friction: of a cone's normal, mu
float* f = mu + NJ;
float* weight = f + NJ;          // s''(r) of a row by itself; of a sliding contact -Dm, then N mu / T
float* along = weight + NJ;      // of a sliding contact: the direction in which it slides, scaled by friction
int* cone = (int*)(along + NJ);  // rows of the contact that begins here; 0: a row by itself, -1: goes with one before

for (int i = lane; i < NV * NV; i += lanes) M[i] = 0.0f;
for (int e = lane; e < n * NV; e += lanes) J[e] = efc_J_row[e / NV * in.efc_J.shape[2] + e % NV];
for (int row = lane; row < n; row += lanes) {
    D[row] = in.efc_D.data[(size_t)world * in.efc_D.shape[1] + row];
    cone[row] = 0;
    if (in.efc_type.data[(size_t)world * in.efc_type.shape[1] + row] != ELLIPTIC) continue;
    const int contact = in.efc_id.data[(size_t)world * in.efc_id.shape[1] + row];
    const int first = in.contact_efc_address.data[contact * in.contact_efc_address.shape[1]];
    const float* friction = (const float*)(in.contact_friction.data + contact);
    cone[row] = row == first ? in.contact_dim.data[contact] : -1;
    if (cone[row] > n - row) cone[row] = n - row;  // cut off by the end of the buffer
    mu[row] = row == first ? friction[0] * shrink : friction[row - first - 1];
}
sync();
for (int i = lane; i < NV; i += lanes) {
    a[i] = n ? in.qacc_warmstart.data[world * NV + i] : in.qacc_smooth.data[world * NV + i];
    for (int k = in.M_rowadr.data[i]; k < in.M_rowadr.data[i] + in.M_rownnz.data[i]; ++k) {
        const int j = in.M_colind.data[k];
        M[i * NV + j] = M[j * NV + i] = packed[k];
    }
}
sync();
float trace = 0.0f;
for (int i = 0; i < NV; ++i) trace += M[i * NV + i];
const float scale = 1.0f / trace;

// y = M x, and z = J x - b
auto multiply = [&](const float* x, float* y, float* z, const float* b) {
    for (int i = lane; i < NV; i += lanes) {
        float total = 0.0f;
        for (int j = 0; j < NV; ++j) total += M[i * NV + j] * x[j];
        y[i] = total;
    }
    for (int row = lane; row < n; row += lanes) {
        float total = b ? -b[row] : 0.0f;
        for (int j = 0; j < NV; ++j) total += J[row * NV + j] * x[j];
        z[row] = total;
    }
    sync();
};
// First and second derivative of the cost of a row by itself at its residual x.
auto simple = [&](int row, float x, float& first, float& second) {
    first = D[row] * x, second = D[row];
    if (row < equalities) return;
    if (row < bilateral) {
        if (fabsf(first) >= loss[row]) first = x < 0.0f ? -loss[row] : loss[row], second = 0.0f;
    } else if (x >= 0.0f) {
        first = second = 0.0f;
    }
};
// Derivatives of all rows' cost along p at the step t.
auto slope = [&](float t, float& first, float& second) {
    first = second = 0.0f;
    for (int row = lane; row < n; row += lanes) {
        const int dim = cone[row];
        if (dim < 0) continue;
        float d1, d2;
        if (dim == 0) {
            simple(row, r[row] + t * Jp[row], d1, d2);
            first += d1 * Jp[row], second += d2 * Jp[row] * Jp[row];
            continue;
        }
        const float m = mu[row], N = m * (r[row] + t * Jp[row]);
        float TT = 0.0f, UV = 0.0f, VV = 0.0f;
        for (int k = row + 1; k < row + dim; ++k) {
            const float U = mu[k] * (r[k] + t * Jp[k]), V = mu[k] * Jp[k];
            TT += U * U, UV += U * V, VV += V * V;
        }
        const float T = sqrtf(TT);
        if (N >= m * T) continue;
        if (m * N + T <= 0.0f) {
            for (int k = row; k < row + dim; ++k) {
                first += D[k] * Jp[k] * (r[k] + t * Jp[k]), second += D[k] * Jp[k] * Jp[k];
            }
            continue;
        }
        const float Dm = D[row] / (m * m * (1.0f + m * m)), gap = N - m * T, dT = UV / T, dgap = m * (Jp[row] - dT);
        first += Dm * gap * dgap, second += Dm * (dgap * dgap - gap * m * (VV - dT * dT) / T);
    }
    first = sum(first), second = sum(second);
};
// The lower triangle of a symmetric matrix, dealt out to the lanes.
constexpr int triangle = NV * (NV + 1) / 2, entries = (triangle + lanes - 1) / lanes;
int column[entries], line[entries];
for (int e = 0; e < entries; ++e) {
    const int at = e * lanes + lane < triangle ? e * lanes + lane : 0;
    int i = (int)((sqrtf(8.0f * at + 1.0f) - 1.0f) / 2.0f);
    i += (i + 1) * (i + 2) / 2 <= at;
    line[e] = i, column[e] = at - i * (i + 1) / 2;
}

multiply(a, Ma, r, aref);
int iteration = 0;
while (iteration < in.iterations && n) {
    for (int row = lane; row < n; row += lanes) {
        const int dim = cone[row];
        if (dim < 0) continue;
        if (dim == 0) {
            simple(row, r[row], f[row], weight[row]);
            f[row] = -f[row];
            continue;
        }
        const float m = mu[row], N = m * r[row];
        float TT = 0.0f;
        for (int k = row + 1; k < row + dim; ++k) TT += mu[k] * r[k] * mu[k] * r[k];
        const float T = sqrtf(TT);
        if (N >= m * T || m * N + T <= 0.0f) {  // apart, or sticking
            for (int k = row; k < row + dim; ++k) weight[k] = N >= m * T ? 0.0f : D[k], f[k] = -weight[k] * r[k];
            continue;
        }
        const float Dm = D[row] / (m * m * (1.0f + m * m));
        f[row] = -Dm * (N - m * T) * m, weight[row] = -Dm, weight[row + 1] = m * N / T;
        for (int k = row + 1; k < row + dim; ++k) along[k] = mu[k] * mu[k] * r[k] / T, f[k] = -f[row] * along[k];
    }
    sync();
    // gradient g, and Hessian H = M + J' s''(r) J
    float gg = 0.0f;
    for (int i = lane; i < NV; i += lanes) {
        float total = Ma[i] - smooth[i];
        for (int row = 0; row < n; ++row) total -= J[row * NV + i] * f[row];
        g[i] = total, p[i] = -total;
        gg += total * total;
    }
    if (scale * sqrtf(sum(gg)) < limit) break;
    float h[entries];
    for (int e = 0; e < entries; ++e) h[e] = M[line[e] * NV + column[e]];
    for (int row = 0; row < n; ++row) {
        const float* first = J + row * NV;
        if (weight[row] >= 0.0f) {
            if (weight[row] > 0.0f) {
                for (int e = 0; e < entries; ++e) h[e] += weight[row] * first[line[e]] * first[column[e]];
            }
            continue;
        }
        const float m = mu[row], ratio = weight[row + 1];
        for (int e = 0; e < entries; ++e) {
            const int i = line[e], j = column[e];
            float slide_i = 0.0f, slide_j = 0.0f, tangents = 0.0f;
            for (int k = 1; k < cone[row]; ++k) {
                const float Ji = first[k * NV + i], Jj = first[k * NV + j];
                slide_i += along[row + k] * Ji, slide_j += along[row + k] * Jj;
                tangents += mu[row + k] * mu[row + k] * Ji * Jj;
            }
            const float normal_i = m * first[i], normal_j = m * first[j];
            h[e] -= weight[row] * (normal_i * normal_j - m * (normal_i * slide_j + normal_j * slide_i) +
                                   ratio * slide_i * slide_j + (m * m - ratio) * tangents);
        }
        row += cone[row] - 1;
    }
    for (int e = 0; e < entries; ++e) H[line[e] * NV + column[e]] = h[e];
    sync();
    // H = L L', with the inverse of L's diagonal in its place; then p = -H^-1 g
    for (int k = 0; k < NV; ++k) {
        const float inverse = 1.0f / sqrtf(H[k * NV + k] > 1e-15f ? H[k * NV + k] : 1e-15f);
        sync();
        for (int i = k + lane; i < NV; i += lanes) H[i * NV + k] = i == k ? inverse : H[i * NV + k] * inverse;
        sync();
        for (int i = k + 1 + lane; i < NV; i += lanes) {
            for (int j = k + 1; j <= i; ++j) H[i * NV + j] -= H[i * NV + k] * H[j * NV + k];
        }
        sync();
    }
    for (int k = 0; k < NV; ++k) {
        const float x = p[k] * H[k * NV + k];
        sync();
        for (int i = k + lane; i < NV; i += lanes) p[i] = i == k ? x : p[i] - H[i * NV + k] * x;
        sync();
    }
    for (int k = NV - 1; k >= 0; --k) {
        const float x = p[k] * H[k * NV + k];
        sync();
        for (int i = k - lane; i >= 0; i -= lanes) p[i] = i == k ? x : p[i] - H[k * NV + i] * x;
        sync();
    }
    float gp = 0.0f;
    for (int i = lane; i < NV; i += lanes) gp += g[i] * p[i];
    gp = sum(gp);
    if (-0.5f * scale * gp < limit) break;
    ++iteration;
    // the step: Newton's method on the slope along p, kept between steps that are too short and too long
    multiply(p, Mp, Jp, nullptr);
    float gauss = 0.0f, curvature = 0.0f;
    for (int i = lane; i < NV; i += lanes) gauss += p[i] * (Ma[i] - smooth[i]), curvature += p[i] * Mp[i];
    gauss = sum(gauss), curvature = sum(curvature);
    float step = 1.0f, low = 0.0f, high = 1e30f;
    for (int k = 0; k < in.ls_iterations; ++k) {
        float d1, d2;
        slope(step, d1, d2);
        d1 += gauss + step * curvature, d2 += curvature;
        if (fabsf(d1) <= -ls_limit * gp) break;
        if (d1 < 0.0f) low = step;
        else high = step;
        step -= d1 / d2;
        if (!(step > low && step < high)) step = high < 1e30f ? 0.5f * (low + high) : 2.0f * low;
    }
    for (int i = lane; i < NV; i += lanes) a[i] += step * p[i], Ma[i] += step * Mp[i];
    for (int row = lane; row < n; row += lanes) r[row] += step * Jp[row];
    sync();
}
for (int i = lane; i < NV; i += lanes) in.qacc.data[world * NV + i] = a[i], in.efc_Ma.data[world * NV + i] = Ma[i];
if (FORCES) {
    for (int row = lane; row < n; row += lanes) in.efc_force.data[(size_t)world * in.efc_force.shape[1] + row] = f[row];
}
if (lane == 0) in.solver_niter.data[world] = iteration;
