// J and M of many degrees of freedom. J has nonzeros where a degree of freedom moves one of a contact's two bodies: in the same columns
// in all of the contact's rows, the last column first. M couples the degrees of freedom of a tree, at most TREE. H is a triangle in
// shared memory. A lane takes a degree of freedom, its row of H, and the contacts that it moves: lanes of other objects take others.

constexpr int half = 0, width = lanes, turns = (NV + width - 1) / width;
const int c = lane;  // lane c takes the degrees of freedom c, c + width, ...
constexpr int triangle = (NV * (NV + 1) / 2 + 3) / 4 * 4, vector = (NV + 3) / 4 * 4;
float *x = rest, *packed_H = x + vector, *own = packed_H + triangle;  // J, if an environment has no more than ROWS nonzeros
unsigned long long* columns = (unsigned long long*)(own + ROWS);      // of a row by itself or a contact, one bit each
unsigned short *begin = (unsigned short*)(columns + many), *filled = begin + many;  // of a row: where its nonzeros begin, and how many
unsigned char* own_column = (unsigned char*)(filled + many);
auto H = [&](int i, int j) -> float& { return packed_H[i * (i + 1) / 2 + j]; };
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
float m[turns][TREE], diagonal = 0.0f;
UNROLLED
for (int t = 0; t < turns; ++t) {
    const int i = t * width + c;
    low[t] = i < NV ? LOW[i] : NV;
    diagonal += i < NV ? H(i, i) : 0.0f;
UNROLLED
    for (int k = 0; k < TREE; ++k) {
        const int j = low[t] + k;
        m[t][k] = i < NV && j < HIGH[i] ? (j < i ? H(i, j) : H(j, i)) : 0.0f;
    }
}
const float scale = 1.0f / sum(diagonal);
sync();

for (int at = lane; at < parts; at += lanes) {
    columns[at] = 0;
    for (int k = begin[first[at]]; k < begin[first[at]] + filled[first[at]]; ++k) columns[at] |= 1ull << column(k);
}
sync();
// Of 64 parts from ``at`` on, those that a degree of freedom moves, one bit each.
auto moved = [&](int i, int at) {
    unsigned long long found = 0;
    for (int k = 0; k < 64 && at + k < parts; ++k) found |= (columns[at + k] >> i & 1) << k;
    return found;
};
unsigned long long moves[turns];
UNROLLED
for (int t = 0; t < turns; ++t) moves[t] = t * width + c < NV ? moved(t * width + c, 0) : 0;
// Calls ``use`` with the parts that a lane's degree of freedom moves: (row, number of rows, nonzeros in each, the place of the lane's).
auto each_moved = [&](int t, auto use) {
    const int i = t * width + c;
    for (int at = 0; i < NV && at < parts; at += 64) {
        for (unsigned long long left = at ? moved(i, at) : moves[t]; left; left &= left - 1) {
            const int k = at + count((left & -left) - 1), row = first[k];
            int place = begin[row];
            if (cone[row]) place += count(columns[k] >> i >> 1);
            else while (column(place) != i) ++place;  // two joints that are coupled are in any order
            use(row, cone[row] ? cone[row] : 1, filled[row], place);
        }
    }
};

// y = M v, and z = J v - b
auto multiply = [&](const float* v, float* y, float* z, const float* b) {
UNROLLED
    for (int t = 0; t < turns; ++t) {
        if (t * width + c < NV) x[t * width + c] = v[t];
    }
    sync();
UNROLLED
    for (int t = 0; t < turns; ++t) {
        y[t] = 0.0f;
UNROLLED
        for (int k = 0; k < TREE; ++k) {
            if (low[t] + k < NV) y[t] += m[t][k] * x[low[t] + k];
        }
    }
    for (int row = lane; row < n; row += lanes) {
        float total = b ? -b[row] : 0.0f;
        for (int at = begin[row]; at < begin[row] + filled[row]; ++at) total += J[at] * x[column(at)];
        z[row] = total;
    }
    sync();
};
// y += J' f
auto add_forces = [&](float* y) {
    UNROLLED
    for (int t = 0; t < turns; ++t) {
        each_moved(t, [&](int row, int rows, int apart, int place) {
#pragma unroll 1
            for (int k = 0; k < rows; ++k) y[t] += J[place + k * apart] * f[row + k];
        });
    }
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
            if (i < NV && low[t] + k <= i) H(i, low[t] + k) = m[t][k];
        }
        y[t] = i < NV ? -g[t] : 0.0f;
        each_moved(t, [&](int row, int rows, int apart, int place) {
            if (weight[row] == 0.0f) return;
            float own_J[6], force[6];  // a column of J, and of s''(r) J
            UNROLLED
            for (int k = 0; k < 6; ++k) own_J[k] = k < rows ? J[place + k * apart] : 0.0f;
            if (weight[row] > 0.0f) {
                UNROLLED
                for (int k = 0; k < 6; ++k) force[k] = k < rows ? weight[row + k] * own_J[k] : 0.0f;
            } else {
                const float Dm = -weight[row], ratio = along[row], m_ = mu[row], normal = m_ * own_J[0];
                float slide = 0.0f;
                UNROLLED
                for (int k = 1; k < 6; ++k) slide += k < rows ? along[row + k] * own_J[k] : 0.0f;
                force[0] = Dm * m_ * (normal - m_ * slide);
                const float push = ratio * slide - m_ * normal;
                UNROLLED
                for (int k = 1; k < 6; ++k) {
                    force[k] = k < rows ? Dm * (along[row + k] * push + (m_ * m_ - ratio) * mu[row + k] * mu[row + k] * own_J[k]) : 0.0f;
                }
            }
            for (int at = begin[row]; at < begin[row] + apart; ++at) {
                const int j = column(at);
                if (j > i) continue;
                float total = 0.0f;
                UNROLLED
                for (int k = 0; k < 6; ++k) total += k < rows ? force[k] * J[at + k * apart] : 0.0f;
                H(i, j) += total;
            }
        });
    }
    sync();
    // H = L' L, with the inverse of L's diagonal in its place: from the last row on, as objects come last and only what touches them
    // fills their columns. On the way y = -L'^-1 g; then p = L^-1 y.
    UNROLLED
    for (int t = turns - 1; t >= 0; --t) {
        for (int owner = (t < turns - 1 ? lanes : NV - t * lanes) - 1; owner >= 0; --owner) {
            const int k = t * lanes + owner;
            const float inverse = inverse_root(H(k, k) > 1e-15f ? H(k, k) : 1e-15f), done = of(owner, y[t]) * inverse;
            float entry[turns];
            UNROLLED
            for (int u = 0; u <= t; ++u) {
                const int i = u * lanes + lane;
                entry[u] = i < k ? H(k, i) * inverse : 0.0f;
                y[u] -= entry[u] * done;
            }
            sync();
            if (lane == owner) H(k, k) = inverse, y[t] = done;
            UNROLLED
            for (int v = 0; v <= t; ++v) {
                if (entry[v] != 0.0f) H(k, v * lanes + lane) = entry[v];
                for (unsigned long long left = bits(entry[v] != 0.0f); left; left &= left - 1) {
                    const int at = count((left & -left) - 1), j = v * lanes + at;
                    const float other = of(at, entry[v]);
                    UNROLLED
                    for (int u = v; u <= t; ++u) {
                        const int i = u * lanes + lane;
                        if (entry[u] != 0.0f && i >= j) H(i, j) -= entry[u] * other;
                    }
                }
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
