// J and M of few degrees of freedom. A lane has columns of H and of M in registers; of two halves, each adds every other row to H. J is
// in shared memory if an environment has no more than ROWS rows, as nearly all have.

#if defined(__CUDA_ARCH__)
using Four = float4;
#else
struct alignas(16) Four { float x, y, z, w; };
#endif
auto total_of = [](const float* x) { return (x[0] + x[1]) + (x[2] + x[3]); };
auto put = [](float* to, Four v) { to[0] = v.x, to[1] = v.y, to[2] = v.z, to[3] = v.w; };
auto add = [](float* to, float times, Four v) { to[0] += times * v.x, to[1] += times * v.y, to[2] += times * v.z, to[3] += times * v.w; };
auto four = [](const float* x, int q) { return ((const Four*)x)[q]; };
// An odd number of quads, so that lanes that read one row each meet different banks.
constexpr int quads = (NV + 3) / 4, stride = 4 * (quads | 1);
float *L = rest, *own = L + NV * stride;
short* active = (short*)(own + ROWS * stride);  // the rows with weight > 0, and from the end on the contacts that slide
const bool near = n <= ROWS;
const float* J = near ? own : efc_J;
const int apart = near ? stride : in.efc_J.shape[2];

#pragma unroll 4
for (int e = lane; near && e < n * quads; e += lanes) {
    ((Four*)(own + e / quads * stride))[e % quads] = four(efc_J + e / quads * in.efc_J.shape[2], e % quads);
}
for (int i = lane; i < NV * stride; i += lanes) L[i] = 0.0f;
for (int j = lane; j < 4 * quads; j += lanes) x[j] = 0.0f;
sync();
UNROLLED
for (int k = lane; k < NM; k += lanes) L[M_ROW[k] * stride + M_COLUMN[k]] = L[M_COLUMN[k] * stride + M_ROW[k]] = packed[k];
sync();
float mass[turns][4 * quads], diagonal = 0.0f;
UNROLLED
for (int t = 0; t < turns; ++t) {
    const int i = t * width + c;
    diagonal += half == 0 && i < NV ? L[i * stride + i] : 0.0f;
    UNROLLED
    for (int q = 0; q < quads; ++q) {
        put(mass[t] + 4 * q, four(i < NV ? L + i * stride : x, q));  // x holds zeros
    }
}
const float scale = 1.0f / sum(diagonal);
sync();

// y = M vector, and z = J vector - b
auto multiply = [&](const float* vector, float* y, float* z, const float* b) {
    share(vector);
    UNROLLED
    for (int t = 0; t < turns; ++t) {
        float sums[4] = {};
        UNROLLED
        for (int q = 0; q < quads; ++q) {
            const Four v = four(x, q);
            sums[0] += mass[t][4 * q] * v.x, sums[1] += mass[t][4 * q + 1] * v.y;
            sums[2] += mass[t][4 * q + 2] * v.z, sums[3] += mass[t][4 * q + 3] * v.w;
        }
        y[t] = total_of(sums);
    }
#pragma unroll 1
    for (int row = lane; row < n; row += lanes) {
        float sums[4] = {b ? -b[row] : 0.0f, 0.0f, 0.0f, 0.0f};
        UNROLLED
        for (int q = 0; q < quads; ++q) {
            const Four u = four(J + row * apart, q), v = four(x, q);
            sums[0] += u.x * v.x, sums[1] += u.y * v.y, sums[2] += u.z * v.z, sums[3] += u.w * v.w;
        }
        z[row] = total_of(sums);
    }
    sync();
};
// y = J' f
auto pull = [&](float* y) {
    UNROLLED
    for (int t = 0; t < turns; ++t) {
        const int i = t * width + c;
        float total = 0.0f;
#pragma unroll 4
        for (int row = half; i < NV && row < n; row += halves) total += J[row * apart + i] * f[row];
        y[t] = halves == 1 ? total : total + of(lane ^ width, total);
    }
};
// p = -H^-1 g with H = M + J' s''(r) J
auto direction = [&](const float* g, float* p) {
    const int those = list(active, 1, [&](int row) { return weight[row] > 0.0f; });
    const int sliding = list(active + NJ - 1, -1, [&](int row) { return weight[row] < 0.0f; });
    sync();
    float h[turns][4 * quads], y[turns], inverse[turns];
    UNROLLED
    for (int t = 0; t < turns; ++t) {
        for (int j = 0; j < 4 * quads; ++j) h[t][j] = half == 0 ? mass[t][j] : 0.0f;
    }
    auto add_row = [&](float* column, const float* row, float times) {
        UNROLLED
        for (int q = 0; q < quads; ++q) add(column + 4 * q, times, four(row, q));
    };
#pragma unroll 2
    for (int at = half; at < those; at += halves) {
        const int row = active[at];
        UNROLLED
        for (int t = 0; t < turns; ++t) {
            const int i = t * width + c;
            add_row(h[t], J + row * apart, i < NV ? weight[row] * J[row * apart + i] : 0.0f);
        }
    }
#pragma unroll 1
    for (int at = half; at < sliding; at += halves) {
        const int row = active[NJ - 1 - at];
        const float Dm = -weight[row], ratio = along[row], m = mu[row];
        UNROLLED
        for (int t = 0; t < turns; ++t) {
            const int i = t * width + c < NV ? t * width + c : 0;
            const float* at_i = J + row * apart + i;
            float slide = 0.0f;
#pragma unroll 1
            for (int k = 1; k < cone[row]; ++k) slide += along[row + k] * at_i[k * apart];
            const float normal = m * at_i[0], push = ratio * slide - m * normal;
            add_row(h[t], J + row * apart, Dm * m * (normal - m * slide));
#pragma unroll 1
            for (int k = 1; k < cone[row]; ++k) {
                const float tangent = (m * m - ratio) * mu[row + k] * mu[row + k] * at_i[k * apart];
                add_row(h[t], J + (row + k) * apart, Dm * (along[row + k] * push + tangent));
            }
        }
    }
    UNROLLED
    for (int t = 0; t < turns; ++t) {
        for (int j = 0; halves == 2 && j < NV; ++j) h[t][j] += of(lane ^ width, h[t][j]);
        y[t] = -g[t];
    }
    // H = L' L from the last row on, as objects come last; on the way y = L'^-1 y. Then y = L^-1 y.
    UNROLLED
    for (int k = NV - 1; k >= 0; --k) {
        const float pivot = of(k % width, h[k / width][k]), root = inverse_root(pivot > 1e-15f ? pivot : 1e-15f);
        const float done = of(k % width, y[k / width]) * root;
        float entry[turns];
        UNROLLED
        for (int t = 0; t < turns; ++t) {
            const int i = t * width + c;
            entry[t] = h[t][k] * root;
            if (i < k) L[k * stride + i] = entry[t], y[t] -= entry[t] * done;
            if (i == k) y[t] = done, inverse[t] = root;
        }
        sync();
        UNROLLED
        for (int t = 0; t < turns; ++t) {
            UNROLLED
            for (int q = 0; q < (k + 3) / 4; ++q) {  // what is behind k is not read any more
                add(h[t] + 4 * q, -entry[t], four(L + k * stride, q));
            }
        }
    }
    UNROLLED
    for (int t = 0; t < turns; ++t) {
        const int i = t * width + c < NV ? t * width + c : 0;
        UNROLLED
        for (int q = 0; q < quads; ++q) {
            put(h[t] + 4 * q, four(L + i * stride, q));
        }
    }
    UNROLLED
    for (int k = 0; k < NV; ++k) {
        const float done = of(k % width, y[k / width] * inverse[k / width]);
        UNROLLED
        for (int t = 0; t < turns; ++t) {
            if (t * width + c > k) y[t] -= h[t][k] * done;
        }
    }
    UNROLLED
    for (int t = 0; t < turns; ++t) p[t] = t * width + c < NV ? y[t] * inverse[t] : 0.0f;
};
