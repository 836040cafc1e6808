// J and M of many degrees of freedom. J has nonzeros where a degree of freedom moves one of a contact's two bodies: in the same columns
// in all of the contact's rows, which follow one another. They are in shared memory if an environment has no more than ROWS of them.
// M couples the degrees of freedom of a tree, at most TREE. H is a triangle in shared memory.

constexpr int triangle = (NV * (NV + 1) / 2 + 3) / 4 * 4;
float *packed_H = rest, *own = packed_H + triangle;
unsigned short *begin = (unsigned short*)(own + ROWS), *filled = begin + many;  // of a row: where its nonzeros begin, and how many
unsigned char *own_column = (unsigned char*)(filled + many), *met = own_column + ROWS;  // ... and columns met while factorising
auto H = [&](int i, int j) -> float& { return packed_H[i * (i + 1) / 2 + j]; };
// The pair v <= u at a place of a triangle. Most triangles have fewer places than there are lanes.
struct Pair { int u, v; };
auto pair_at = [&](int at) {
    const float square = 8.0f * at + 1.5f;
    const int u = (int)(0.5f * (square * inverse_root(square) - 1.0f));
    return Pair{u, at - u * (u + 1) / 2};
};
const Pair mine = pair_at(lane);
const int* efc_column = in.efc_J_colind.data + (size_t)world * in.efc_J_colind.shape[1] * in.efc_J_colind.shape[2];
int nonzeros = 0;
#pragma unroll 2
for (int row = lane; row < n; row += lanes) {
    begin[row] = in.efc_J_rowadr.data[(size_t)world * in.efc_J_rowadr.shape[1] + row];
    filled[row] = in.efc_J_rownnz.data[(size_t)world * in.efc_J_rownnz.shape[1] + row];
    if (begin[row] + filled[row] > nonzeros) nonzeros = begin[row] + filled[row];
}
nonzeros = most(nonzeros);
const bool near = nonzeros <= ROWS;
const float* J = near ? own : efc_J;
auto column = [&](int at) { return near ? own_column[at] : efc_column[at]; };
#pragma unroll 4
for (int at = lane; near && at < nonzeros; at += lanes) own[at] = efc_J[at], own_column[at] = efc_column[at];
for (int at = lane; at < triangle; at += lanes) packed_H[at] = 0.0f;
sync();
UNROLLED
for (int k = lane; k < NM; k += lanes) H(M_ROW[k], M_COLUMN[k]) = packed[k];
sync();
int low[turns];  // the first degree of freedom of a lane's tree
float mass[turns][TREE], diagonal = 0.0f;
UNROLLED
for (int t = 0; t < turns; ++t) {
    const int i = t * width + c;
    low[t] = i < NV ? LOW[i] : NV;
    diagonal += i < NV ? H(i, i) : 0.0f;
    UNROLLED
    for (int k = 0; k < TREE; ++k) {
        const int j = low[t] + k;
        mass[t][k] = i < NV && j < HIGH[i] ? (j < i ? H(i, j) : H(j, i)) : 0.0f;
    }
}
const float scale = 1.0f / sum(diagonal);
sync();

// Friction of a joint's own is alone in its row and its column, so all such rows are added at once, and the others one by one.
auto alone = [&](int row) { return row >= equalities && row < bilateral && filled[row] == 1; };
auto each_alone = [&](auto add) {
    for (int row = equalities + lane; row < bilateral && row < n; row += lanes) {
        if (alone(row)) add(row, column(begin[row]));
    }
};

// y = M vector, and z = J vector - b
auto multiply = [&](const float* vector, float* y, float* z, const float* b) {
    share(vector);
    UNROLLED
    for (int t = 0; t < turns; ++t) {
        y[t] = 0.0f;
        UNROLLED
        for (int k = 0; k < TREE; ++k) {
            if (low[t] + k < NV) y[t] += mass[t][k] * x[low[t] + k];
        }
    }
    for (int row = lane; row < n; row += lanes) {
        float total = b ? -b[row] : 0.0f;
        for (int at = begin[row]; at < begin[row] + filled[row]; ++at) total += J[at] * x[column(at)];
        z[row] = total;
    }
    sync();
};
// y = J' f
auto pull = [&](float* y) {
    for (int i = lane; i < NV; i += lanes) x[i] = 0.0f;
    sync();
    each_alone([&](int row, int i) { x[i] = J[begin[row]] * f[row]; });
    for (int at = 0; at < parts; ++at) {
        const int row = first[at], rows = cone[row] ? cone[row] : 1;
        if (f[row] == 0.0f || alone(row)) continue;
        sync();
        for (int e = lane; e < filled[row]; e += lanes) {
            float total = 0.0f;
#pragma unroll 1
            for (int k = 0; k < rows; ++k) total += J[begin[row] + k * filled[row] + e] * f[row + k];
            x[column(begin[row] + e)] += total;
        }
    }
    sync();
    UNROLLED
    for (int t = 0; t < turns; ++t) y[t] = t * width + c < NV ? x[t * width + c] : 0.0f;
    sync();
};
// An entry of J' s''(r) J of a contact that slides: of two columns of J.
auto sliding = [&](int row, const float* Ji, const float* Jj, int apart) {
    const float m = mu[row], ratio = along[row], normal_i = m * Ji[0], normal_j = m * Jj[0];
    float slide_i = 0.0f, slide_j = 0.0f, tangents = 0.0f;
#pragma unroll 1
    for (int k = 1; k < cone[row]; ++k) {
        const float i = Ji[k * apart], j = Jj[k * apart];
        slide_i += along[row + k] * i, slide_j += along[row + k] * j;
        tangents += mu[row + k] * mu[row + k] * i * j;
    }
    return -weight[row] * (normal_i * normal_j - m * (normal_i * slide_j + normal_j * slide_i) + ratio * slide_i * slide_j +
                           (m * m - ratio) * tangents);
};
// p = -H^-1 g with H = M + J' s''(r) J
auto direction = [&](const float* g, float* p) {
    for (int at = lane; at < triangle; at += lanes) packed_H[at] = 0.0f;
    sync();
    float y[turns];
    UNROLLED
    for (int t = 0; t < turns; ++t) {
        const int i = t * width + c;
        UNROLLED
        for (int k = 0; k < TREE; ++k) {
            if (i < NV && low[t] + k <= i) H(i, low[t] + k) = mass[t][k];
        }
        y[t] = i < NV ? -g[t] : 0.0f;
    }
    sync();
    each_alone([&](int row, int i) { H(i, i) += weight[row] * J[begin[row]] * J[begin[row]]; });
    for (int at = 0; at < parts; ++at) {
        const int row = first[at], rows = cone[row] ? cone[row] : 1, apart = filled[row];
        if (weight[row] == 0.0f || alone(row)) continue;
        sync();
        Pair its = mine;
        for (int e = lane; e < apart * (apart + 1) / 2; e += lanes, its = pair_at(e)) {
            const float *Ju = J + begin[row] + its.u, *Jv = J + begin[row] + its.v;
            float total = 0.0f;
            if (weight[row] < 0.0f) {
                total = sliding(row, Ju, Jv, apart);
            } else {
#pragma unroll 1
                for (int k = 0; k < rows; ++k) total += weight[row + k] * Ju[k * apart] * Jv[k * apart];
            }
            const int i = column(begin[row] + its.u), j = column(begin[row] + its.v);
            H(i > j ? i : j, i > j ? j : i) += total;
        }
    }
    sync();
    // H = L' L, with the inverse of L's diagonal in its place: from the last row on, as objects come last and only what touches them
    // fills their columns. On the way y = -L'^-1 g; then p = L^-1 y.
    for (int t = turns - 1; t >= 0; --t) {
        for (int owner = (t < turns - 1 ? lanes : NV - t * lanes) - 1; owner >= 0; --owner) {
            const int k = t * lanes + owner;
            const float inverse = inverse_root(H(k, k) > 1e-15f ? H(k, k) : 1e-15f), done = of(owner, y[t]) * inverse;
            unsigned long long nonzero = 0;
            for (int u = 0; u <= t; ++u) {
                const int i = u * lanes + lane;
                const float entry = i < k ? H(k, i) * inverse : 0.0f;
                nonzero |= bits(entry != 0.0f) << (u * lanes);
                if (entry == 0.0f) continue;
                H(k, i) = entry, y[u] -= entry * done;
                met[count(nonzero & ((1ull << i) - 1))] = i;
            }
            sync();
            if (lane == owner) H(k, k) = inverse, y[t] = done;
            const int found = count(nonzero);
            Pair its = mine;
            for (int e = lane; e < found * (found + 1) / 2; e += lanes, its = pair_at(e)) {
                const int i = met[its.u], j = met[its.v];
                H(i, j) -= H(k, i) * H(k, j);
            }
            sync();
        }
    }
    for (int t = 0; t < turns; ++t) {
        for (int owner = 0; owner < (t < turns - 1 ? lanes : NV - t * lanes); ++owner) {
            const int k = t * lanes + owner;
            const float done = of(owner, y[t]) * H(k, k);
            if (lane == owner) y[t] = done;
            for (int u = t; u < turns; ++u) {
                const int i = u * lanes + lane;
                if (i > k && i < NV) y[u] -= H(i, k) * done;
            }
        }
    }
    UNROLLED
    for (int t = 0; t < turns; ++t) p[t] = y[t];
};
