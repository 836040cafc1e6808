// One environment: a <- argmin  1/2 (a - smooth)' M (a - smooth) + s(J a - aref).
// NV degrees of freedom, at most NJ rows, n of them in use; r = J a - aref, f = -s'(r), p the search direction.
// The rows of a contact with an elliptic cone follow one another; the first, the normal's, stands for all of them.
// J is dense, and in shared memory; or sparse (DENSE 0) and where MuJoCo Warp has it, with the nonzeros of a contact's rows in the
// same columns, those of the degrees of freedom that move one of its two bodies.
//
// The body of a function of (tid, problem) that newton.py compiles, after the constants NV, NJ, DENSE, SIZE, ELLIPTIC and FORCES.

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
auto of = [](int owner, float x) { return __shfl_sync(0xffffffff, x, owner); };
auto bits = [](bool x) { return (unsigned long long)__ballot_sync(0xffffffff, x); };
auto count = [](unsigned long long x) { return __popcll(x); };
auto inverse_root = [](float x) { return rsqrtf(x); };
#else
constexpr int lanes = 1;
const int lane = 0;
float s[SIZE];
auto sync = [] {};
auto sum = [](float x) { return x; };
auto of = [](int, float x) { return x; };
auto bits = [](bool x) { return (unsigned long long)x; };
auto count = [](unsigned long long x) { return __builtin_popcountll(x); };
auto inverse_root = [](float x) { return 1.0f / sqrtf(x); };
#endif
constexpr int turns = (NV + lanes - 1) / lanes;  // of the lanes through the degrees of freedom
const int world = tid / lanes, n = in.nefc.data[world] < NJ ? in.nefc.data[world] : NJ;
const int equalities = in.ne.data[world], bilateral = equalities + in.nf.data[world];
const float* efc_J = in.efc_J.data + (size_t)world * in.efc_J.shape[1] * in.efc_J.shape[2];
const int *width = in.efc_J_rownnz.data + (size_t)world * in.efc_J_rownnz.shape[1];  // of sparse rows: nonzeros, where they begin,
const int *begin = in.efc_J_rowadr.data + (size_t)world * in.efc_J_rowadr.shape[1];  // and their columns
const int* column = in.efc_J_colind.data + (size_t)world * in.efc_J_colind.shape[1] * in.efc_J_colind.shape[2];
const float* aref = in.efc_aref.data + (size_t)world * in.efc_aref.shape[1];
const float* loss = in.efc_frictionloss.data + (size_t)world * in.efc_frictionloss.shape[1];
const float* packed = in.M.data + (size_t)world * in.M.shape[1];
const float* smooth = in.qfrc_smooth.data + world * NV;
const float shrink = in.impratio_invsqrt.data[world % in.impratio_invsqrt.shape[0]];
const float limit = in.tolerance.data[world % in.tolerance.shape[0]];
const float ls_limit = in.ls_tolerance.data[world % in.ls_tolerance.shape[0]];

// A square for two triangles: H's with its diagonal, H[i][j] with j <= i, and right of it M's.
constexpr int stride = (NV + 1) | 1, triangle = NV * (NV + 1) / 2;
auto H = [&](int i, int j) -> float& { return s[i * stride + j]; };
auto M = [&](int i, int j) -> float& { return i < j ? s[i * stride + j + 1] : s[j * stride + i + 1]; };
float *a = s + NV * stride, *p = a + NV, *g = p + NV, *Ma = g + NV, *Mp = Ma + NV, *r = Mp + NV, *Jp = r + NJ;
float* along = Jp;   // of a sliding contact, until Jp takes its place: the direction in which it slides, scaled by friction
float* D = Jp + NJ;  // a row's stiffness ...
float* mu = D + NJ;  // ... and friction: of a cone's normal, mu
float* f = mu + NJ;
float* weight = f + NJ;           // s''(r) of a row by itself; of a sliding contact -Dm, then N mu / T
int* cone = (int*)(weight + NJ);  // rows of the contact that begins here; 0: a row by itself, -1: goes with one before
const float* J = DENSE ? (float*)(cone + NJ) : efc_J;
// The pairs y <= x one after another, and the columns that a step of the factorisation meets.
unsigned char *pair_x = (unsigned char*)(cone + NJ + (DENSE ? NJ * NV : 0)), *pair_y = pair_x + triangle, *met = pair_y + triangle;

for (int i = lane; i < NV * stride; i += lanes) s[i] = 0.0f;
if (DENSE) {
    for (int e = lane; e < n * NV; e += lanes) ((float*)J)[e] = efc_J[e / NV * in.efc_J.shape[2] + e % NV];
}
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
int low[turns], high[turns];  // the tree of a lane's degree of freedom: all that M couples it with
for (int t = 0; t < turns; ++t) {
    const int i = t * lanes + lane;
    low[t] = high[t] = 0;
    if (i >= NV) continue;
    a[i] = in.qacc_warmstart.data[world * NV + i];
    auto root = [&](int j) { return in.M_colind.data[in.M_rowadr.data[j]]; };
    low[t] = root(i), high[t] = i + 1;
    while (high[t] < NV && root(high[t]) == low[t]) ++high[t];
    for (int k = in.M_rowadr.data[i]; k < in.M_rowadr.data[i] + in.M_rownnz.data[i]; ++k) M(i, in.M_colind.data[k]) = packed[k];
    for (int j = 0; j <= i; ++j) pair_x[i * (i + 1) / 2 + j] = i, pair_y[i * (i + 1) / 2 + j] = j;
}
sync();
float trace = 0.0f;
for (int i = 0; i < NV; ++i) trace += M(i, i);
const float scale = 1.0f / trace;

// y = M x, and z = J x - b
auto multiply = [&](const float* x, float* y, float* z, const float* b) {
    for (int t = 0; t < turns; ++t) {
        const int i = t * lanes + lane;
        float total = 0.0f;
#pragma unroll 1  // here and below: what is unrolled no longer fits the instruction cache
        for (int j = low[t]; j < high[t]; ++j) total += M(i, j) * x[j];
        if (i < NV) y[i] = total;
    }
    for (int row = lane; row < n; row += lanes) {
        float total = b ? -b[row] : 0.0f;
        if (DENSE) {
            for (int j = 0; j < NV; ++j) total += J[row * NV + j] * x[j];
        } else {
            for (int k = begin[row]; k < begin[row] + width[row]; ++k) total += J[k] * x[column[k]];
        }
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
// An entry of J' s''(r) J of a contact that slides: of two columns of J, whose rows are so far apart.
auto sliding = [&](int row, const float* Jx, const float* Jy, int apart) {
    const float m = mu[row], ratio = weight[row + 1], normal_x = m * Jx[0], normal_y = m * Jy[0];
    float slide_x = 0.0f, slide_y = 0.0f, tangents = 0.0f;
#pragma unroll 1
    for (int k = 1; k < cone[row]; ++k) {
        const float x = Jx[k * apart], y = Jy[k * apart];
        slide_x += along[row + k] * x, slide_y += along[row + k] * y;
        tangents += mu[row + k] * mu[row + k] * x * y;
    }
    return -weight[row] * (normal_x * normal_y - m * (normal_x * slide_y + normal_y * slide_x) + ratio * slide_x * slide_y +
                           (m * m - ratio) * tangents);
};

multiply(a, Ma, r, aref);
int iteration = 0;
while (iteration < in.iterations) {
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
    // gradient g = M a - smooth - J' f
    for (int i = lane; i < NV; i += lanes) {
        float total = Ma[i] - smooth[i];
        for (int row = 0; DENSE && row < n; ++row) total -= J[row * NV + i] * f[row];
        g[i] = total;
    }
    for (int row = 0; !DENSE && row < n; row += cone[row] ? cone[row] : 1) {
        if (f[row] == 0.0f) continue;
        const int rows = cone[row] ? cone[row] : 1;
        sync();
        for (int x = lane; x < width[row]; x += lanes) {
            float total = 0.0f;
            for (int k = 0; k < rows; ++k) total += J[begin[row] + k * width[row] + x] * f[row + k];
            g[column[begin[row] + x]] -= total;
        }
    }
    sync();
    float gg = 0.0f;
    for (int i = lane; i < NV; i += lanes) gg += g[i] * g[i];
    if (scale * sqrtf(sum(gg)) < limit) break;
    // Hessian H = M + J' s''(r) J
    constexpr int entries = (triangle + lanes - 1) / lanes;
    if (DENSE) {
        float h[entries];
        int x[entries], y[entries];
        for (int e = 0; e < entries; ++e) {
            const int at = e * lanes + lane < triangle ? e * lanes + lane : 0;
            x[e] = pair_x[at], y[e] = pair_y[at], h[e] = M(x[e], y[e]);
        }
        for (int row = 0; row < n; row += weight[row] < 0.0f ? cone[row] : 1) {
            const float* first = J + row * NV;
            if (weight[row] > 0.0f) {
                for (int e = 0; e < entries; ++e) h[e] += weight[row] * first[x[e]] * first[y[e]];
            } else if (weight[row] < 0.0f) {
                for (int e = 0; e < entries; ++e) h[e] += sliding(row, first + x[e], first + y[e], NV);
            }
        }
        for (int e = 0; e < entries; ++e) H(x[e], y[e]) = h[e];
    } else {
        for (int e = lane; e < triangle; e += lanes) H(pair_x[e], pair_y[e]) = M(pair_x[e], pair_y[e]);
        for (int row = 0; row < n; row += cone[row] ? cone[row] : 1) {
            if (weight[row] == 0.0f) continue;
            const int rows = cone[row] ? cone[row] : 1, nonzeros = width[row];
            sync();
            for (int e = lane; e < nonzeros * (nonzeros + 1) / 2; e += lanes) {
                const float *Jx = J + begin[row] + pair_x[e], *Jy = J + begin[row] + pair_y[e];
                float total = 0.0f;
                if (weight[row] < 0.0f) {
                    total = sliding(row, Jx, Jy, nonzeros);
                } else {
                    for (int k = 0; k < rows; ++k) total += weight[row + k] * Jx[k * nonzeros] * Jy[k * nonzeros];
                }
                const int i = column[begin[row] + pair_x[e]], j = column[begin[row] + pair_y[e]];
                H(i > j ? i : j, i > j ? j : i) += total;
            }
        }
    }
    sync();
    // H = L' L, with the inverse of L's diagonal in its place: from the last row on, as objects come last and only what touches them
    // fills their columns. On the way y = -L'^-1 g; then p = L^-1 y.
    float y[turns];
    for (int t = 0; t < turns; ++t) y[t] = t * lanes + lane < NV ? -g[t * lanes + lane] : 0.0f;
    for (int t = turns - 1; t >= 0; --t) {
        for (int owner = (t < turns - 1 ? lanes : NV - t * lanes) - 1; owner >= 0; --owner) {
            const int k = t * lanes + owner;
            const float inverse = inverse_root(H(k, k) > 1e-15f ? H(k, k) : 1e-15f), x = of(owner, y[t]) * inverse;
            unsigned long long nonzero = 0;
            for (int u = 0; u <= t; ++u) {
                const int i = u * lanes + lane;
                const float entry = i < k ? H(k, i) * inverse : 0.0f;
                nonzero |= bits(entry != 0.0f) << (u * lanes);
                if (entry == 0.0f) continue;
                H(k, i) = entry, y[u] -= entry * x;
                met[count(nonzero & ((1ull << i) - 1))] = i;
            }
            sync();
            if (lane == owner) H(k, k) = inverse, y[t] = x;
            const int many = count(nonzero);
            for (int e = lane; e < many * (many + 1) / 2; e += lanes) {
                const int i = met[pair_x[e]], j = met[pair_y[e]];
                H(i, j) -= H(k, i) * H(k, j);
            }
            sync();
        }
    }
    for (int t = 0; t < turns; ++t) {
        for (int owner = 0; owner < (t < turns - 1 ? lanes : NV - t * lanes); ++owner) {
            const int k = t * lanes + owner;
            const float x = of(owner, y[t]) * H(k, k);
            if (lane == owner) y[t] = x;
            for (int u = t; u < turns; ++u) {
                const int i = u * lanes + lane;
                if (i > k && i < NV) y[u] -= H(i, k) * x;
            }
        }
        if (t * lanes + lane < NV) p[t * lanes + lane] = y[t];
    }
    sync();
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
