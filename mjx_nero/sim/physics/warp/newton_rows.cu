// One environment: a <- argmin  1/2 (a - smooth)' M (a - smooth) + s(J a - aref).
// NV degrees of freedom, at most NJ rows, n of them in use; r = J a - aref, f = -s'(r), p the search direction.
// The rows of a contact with an elliptic cone follow one another; the first, the normal's, stands for all of them.
//
// The body of a function of (tid, problem) in three parts: the rows, here; then newton_dense.cu or newton_sparse.cu, which hold J and
// M; then newton.cu, the method. newton.py compiles them after its constants.

const auto& in = problem;
#if defined(__CUDA_ARCH__)
#define UNROLLED _Pragma("unroll")  // keeps an array in registers
constexpr int lanes = 32;
const int lane = threadIdx.x % lanes;
__shared__ __align__(16) float s[SIZE];
auto sync = [] { __syncwarp(); };
auto sum = [](float x) {  // over the lanes
    for (int offset = 16; offset; offset >>= 1) x += __shfl_xor_sync(0xffffffff, x, offset);
    return x;
};
auto sum_both = [](float& x, float& y) {  // at once, as each shuffle waits for the one before
    for (int offset = 16; offset; offset >>= 1) {
        const float dx = __shfl_xor_sync(0xffffffff, x, offset), dy = __shfl_xor_sync(0xffffffff, y, offset);
        x += dx, y += dy;
    }
};
auto most = [](int x) {
    for (int offset = 16; offset; offset >>= 1) x = max(x, __shfl_xor_sync(0xffffffff, x, offset));
    return x;
};
auto of = [](int owner, float x) { return __shfl_sync(0xffffffff, x, owner); };
auto bits = [](bool x) { return (unsigned long long)__ballot_sync(0xffffffff, x); };
auto count = [](unsigned long long x) { return __popcll(x); };
auto inverse_root = [](float x) { return rsqrtf(x); };
auto over = [](float x, float y) { return __fdividef(x, y); };
#else
#define UNROLLED
constexpr int lanes = 1;
const int lane = 0;
alignas(16) float s[SIZE];
auto sync = [] {};
auto sum = [](float x) { return x; };
auto sum_both = [](float&, float&) {};
auto most = [](int x) { return x; };
auto of = [](int, float x) { return x; };
auto bits = [](bool x) { return (unsigned long long)x; };
auto count = [](unsigned long long x) { return __builtin_popcountll(x); };
auto inverse_root = [](float x) { return 1.0f / sqrtf(x); };
auto over = [](float x, float y) { return x / y; };
#endif
const int world = tid / lanes, n = in.nefc.data[world] < NJ ? in.nefc.data[world] : NJ;
const int equalities = in.ne.data[world], bilateral = equalities + in.nf.data[world];
const float* efc_J = in.efc_J.data + (size_t)world * in.efc_J.shape[1] * in.efc_J.shape[2];
const float* aref = in.efc_aref.data + (size_t)world * in.efc_aref.shape[1];
const float* packed = in.M.data + (size_t)world * in.M.shape[1];
const float shrink = in.impratio_invsqrt.data[world % in.impratio_invsqrt.shape[0]];
const float limit = in.tolerance.data[world % in.tolerance.shape[0]];
const float ls_limit = in.ls_tolerance.data[world % in.ls_tolerance.shape[0]];

constexpr float infinite = 1e30f;
constexpr int many = (NJ + 7) / 8 * 8;  // so that ``rest``, after numbers and shorts, begins at a multiple of 16 bytes
float *r = s, *Jp = r + many;
float* along = Jp;     // of a sliding contact, until Jp takes its place: N mu / T, and the direction in which it slides, times friction
float* D = Jp + many;  // a row's stiffness ...
float* mu = D + many;  // ... and friction: of a cone's normal, mu; of a row by itself the largest force, or 0 if it only pushes
float* f = mu + many;
float* weight = f + many;               // s''(r) of a row by itself; of a contact that slides -Dm, then zeros
short* cone = (short*)(weight + many);  // rows of the contact that begins here; 0: a row by itself, -1: goes with one before
short* first = cone + many;             // the rows by themselves, and those that begin a contact
float* x = (float*)(first + many);      // of each degree of freedom, for all lanes to read
float* rest = x + (NV + 3) / 4 * 4;

// Lane c has the degrees of freedom c, c + width, ... If half of the lanes suffice for all, the other half does the same for other rows.
constexpr int halves = DENSE && lanes == 32 && NV <= 16 ? 2 : 1, width = lanes / halves, turns = (NV + width - 1) / width;
const int half = lane / width, c = lane % width;
auto share = [&](const float* vector) {
    UNROLLED
    for (int t = 0; t < turns; ++t) {
        if (t * width + c < NV) x[t * width + c] = vector[t];
    }
    sync();
};

#pragma unroll 2
for (int row = lane; row < n; row += lanes) {
    auto here = [&](const auto& array) { return array.data[(size_t)world * array.shape[1] + row]; };
    const bool elliptic = here(in.efc_type) == ELLIPTIC;
    const int contact = elliptic ? here(in.efc_id) : 0;
    const int begin = in.contact_efc_address.data[contact * in.contact_efc_address.shape[1]], dim = in.contact_dim.data[contact];
    const float *friction = (const float*)(in.contact_friction.data + contact), loss = here(in.efc_frictionloss);
    const int k = elliptic ? row - begin : 0;
    const float rubs = k == 0 ? friction[0] * shrink : friction[k - 1];
    D[row] = here(in.efc_D);
    cone[row] = !elliptic ? 0 : k == 0 ? (dim < n - row ? dim : n - row) : -1;  // the end of the buffer may cut it off
    mu[row] = elliptic ? rubs : row < equalities ? infinite : row < bilateral ? loss : 0.0f;
}
sync();
// Lists the rows for which a condition holds, in order.
auto list = [&](short* to, int step, auto holds) {
    int found = 0;
#pragma unroll 1
    for (int at = 0; at < n; at += lanes) {
        const int row = at + lane;
        const bool is = row < n && holds(row);
        const unsigned long long those = bits(is);
        if (is) to[step * (found + count(those & ((1ull << lane) - 1)))] = row;
        found += count(those);
    }
    return found;
};
const int parts = list(first, 1, [&](int row) { return cone[row] >= 0; });
sync();

// First and second derivative at the residual x of the cost of a row by itself, whose force has a bound; 0: it only pushes.
auto simple = [&](float stiffness, float bound, float x, float& slope, float& curve) {
    slope = stiffness * x, curve = stiffness;
    if (slope >= bound) slope = bound, curve = 0.0f;
    if (bound > 0.0f && slope <= -bound) slope = -bound, curve = 0.0f;
};
// Forces and weights at the residuals r.
auto forces = [&] {
#pragma unroll 1
    for (int at = lane; at < parts; at += lanes) {
        const int row = first[at], dim = cone[row];
        if (dim == 0) {
            simple(D[row], mu[row], r[row], f[row], weight[row]);
            f[row] = -f[row];
            continue;
        }
        const float m = mu[row], N = m * r[row];
        float TT = 1e-30f;
#pragma unroll 1  // here and below: most contacts have three rows, and code that is longer than needed does not fit the cache
        for (int k = row + 1; k < row + dim; ++k) TT += mu[k] * r[k] * mu[k] * r[k];
        const float each = inverse_root(TT), T = TT * each;
        if (N >= m * T || m * N + T <= 0.0f) {  // apart, or sticking
#pragma unroll 1
            for (int k = row; k < row + dim; ++k) weight[k] = N >= m * T ? 0.0f : D[k], f[k] = -weight[k] * r[k];
            continue;
        }
        const float Dm = over(D[row], m * m * (1.0f + m * m));
        f[row] = -Dm * (N - m * T) * m, weight[row] = -Dm, along[row] = m * N * each;
#pragma unroll 1
        for (int k = row + 1; k < row + dim; ++k) along[k] = mu[k] * mu[k] * r[k] * each, f[k] = -f[row] * along[k], weight[k] = 0.0f;
    }
    sync();
};
// A row by itself or a contact, along p.
struct Part {
    float x, dx, stiffness, mu;  // of the first row
    float UU, UV, VV;            // squares of its tangents U = mu r and V = mu J p; UU < 0: it has none
};
auto part = [&](int at) {
    const int row = first[at], dim = cone[row];
    Part its = {r[row], Jp[row], D[row], mu[row], dim ? 0.0f : -1.0f, 0.0f, 0.0f};
#pragma unroll 1
    for (int k = row + 1; k < row + dim; ++k) {
        const float U = mu[k] * r[k], V = mu[k] * Jp[k];
        its.UU += U * U, its.UV += U * V, its.VV += V * V;
    }
    return its;
};
// Adds the derivatives of its cost at the step t.
auto add_slope = [&](const Part& its, float t, float& one, float& two) {
    const float x = its.x + t * its.dx, m = its.mu;
    if (its.UU < 0.0f) {
        float d1, d2;
        simple(its.stiffness, m, x, d1, d2);
        one += d1 * its.dx, two += d2 * its.dx * its.dx;
        return;
    }
    const float N = m * x, UV = its.UV + t * its.VV, TT = its.UU + t * (its.UV + UV);
    const float each = inverse_root(TT > 1e-30f ? TT : 1e-30f), T = TT * each;
    if (N >= m * T) return;
    if (m * N + T <= 0.0f) {  // the stiffness of tangent k is D mu_k^2 / m^2
        const float tangent = over(its.stiffness, m * m);
        one += its.stiffness * its.dx * x + tangent * UV, two += its.stiffness * its.dx * its.dx + tangent * its.VV;
        return;
    }
    const float Dm = over(its.stiffness, m * m * (1.0f + m * m)), gap = N - m * T, dT = UV * each, dgap = m * (its.dx - dT);
    one += Dm * gap * dgap, two += Dm * (dgap * dgap - gap * m * (its.VV - dT * dT) * each);
};
