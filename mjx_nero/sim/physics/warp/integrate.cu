// One tree of one environment, one thread: MuJoCo's integrator "implicitfast" (mujoco.readthedocs.io, Computation, "Numerical integration"),
//
//     v <- v + h x,  (M - h dF/dv) x = M qacc,   q <- q + h v
//
// where F are the forces of dampers and drives and, for a body that flies freely, those of its spin.
//
// The body of a function of (tid, problem) that dynamics.py compiles, after the model's sizes and tables.

const int worlds = problem.qpos.shape[0], world = tid % worlds, part = tid / worlds;
const int first_dof = FIRST_DOF[PART[part]], end_dof = FIRST_DOF[PART[part + 1]];
const auto& in = problem;
const float h = in.timestep.data[world % in.timestep.shape[0]];
const float* M = in.M.data + (size_t)world * in.M.shape[1];
const float *qacc = in.qacc.data + (size_t)world * NV, *Ma = in.efc_Ma.data + (size_t)world * NV;
const float* implicit = in.implicit.data + (size_t)world * NV;
float *qpos = in.qpos.data + (size_t)world * NQ, *qvel = in.qvel.data + (size_t)world * NV;
float own_x[DOFS], *const x = own_x - first_dof;  // one tree's, at the model's indices

// A = M - h dF/dv = L' D L from the last row on, L and D's inverse in A's place; rows of ancestors are prefixes of those below them.
// A tree that is a body which flies freely comes after.
const int end_chain = FLIES[part] ? first_dof : end_dof;
float own_A[ENTRIES], *const A = own_A - ROW[first_dof];
for (int k = ROW[first_dof]; k < ROW[end_chain]; ++k) A[k] = M[k];
for (int i = first_dof; i < end_chain; ++i) x[i] = Ma[i], A[ROW[i + 1] - 1] += h * implicit[i];
#pragma unroll 1
for (int i = end_chain - 1; i >= first_dof; --i) {
    const int begin = ROW[i], last = ROW[i + 1] - 1;
    const float inverse = 1.0f / A[last];
    A[last] = inverse;
#pragma unroll 1
    for (int k = last - 1; k >= begin; --k) {
        const float ratio = A[k] * inverse;
        float* row = A + ROW[COLUMN[k]];
#pragma unroll 1
        for (int e = 0; e <= k - begin; ++e) row[e] -= ratio * A[begin + e];
        A[k] = ratio, x[COLUMN[k]] -= ratio * x[i];
    }
}
#pragma unroll 1
for (int i = first_dof; i < end_chain; ++i) {
    x[i] *= A[ROW[i + 1] - 1];
    for (int k = ROW[i]; k < ROW[i + 1] - 1; ++k) x[i] -= A[k] * x[COLUMN[k]];
}

// Bodies that fly freely, each a system of its own: their spin makes it unsymmetric, so L U, with U's diagonal inverted.
#pragma unroll 1
for (int f = 0; f < NFREE; ++f) {
    const int i = FIRST_DOF[FREE_BODY[f]];
    if (i < first_dof || i >= end_dof) continue;
    const float* spin = in.spin.data + (size_t)world * in.spin.shape[1] + 18 * f;
    float B[6][6], y[6];
    for (int r = 0; r < 6; ++r) {
        for (int c = 0; c < 6; ++c) B[r][c] = c < 3 ? 0.0f : h * spin[3 * r + c - 3];
    }
#pragma unroll 1
    for (int r = 0; r < 6; ++r) {
        for (int k = ROW[i + r]; k < ROW[i + r + 1]; ++k) {
            const int c = COLUMN[k] - i;
            B[r][c] += M[k];
            if (c != r) B[c][r] += M[k];
        }
        B[r][r] += h * implicit[i + r], y[r] = Ma[i + r];
    }
    for (int k = 0; k < 6; ++k) {
        B[k][k] = 1.0f / B[k][k];
        for (int r = k + 1; r < 6; ++r) {
            const float ratio = B[r][k] * B[k][k];
            for (int c = k + 1; c < 6; ++c) B[r][c] -= ratio * B[k][c];
            y[r] -= ratio * y[k];
        }
    }
    for (int r = 5; r >= 0; --r) {
        for (int c = r + 1; c < 6; ++c) y[r] -= B[r][c] * y[c];
        y[r] *= B[r][r], x[i + r] = y[r];
    }
}

for (int i = first_dof; i < end_dof; ++i) {
    qvel[i] += h * x[i], in.qacc_warmstart.data[(size_t)world * NV + i] = qacc[i];
}
#pragma unroll 1
for (int j = FIRST_JOINT[PART[part]]; j < FIRST_JOINT[PART[part + 1]]; ++j) {
    float* q = qpos + QPOS[j];
    const float* v = qvel + DOF[j];
    if (TYPE[j] != FREE) {
        *q += h * *v;
        continue;
    }
    for (int k = 0; k < 3; ++k) q[k] += h * v[k];
    const float speed = sqrtf(v[3] * v[3] + v[4] * v[4] + v[5] * v[5]), half = 0.5f * h * speed;
    const float c = cosf(half), s = speed > 0.0f ? sinf(half) / speed : 0.0f, a = s * v[3], b = s * v[4], d = s * v[5];
    const float w = q[3] * c - q[4] * a - q[5] * b - q[6] * d, i = q[3] * a + q[4] * c + q[5] * d - q[6] * b;
    const float y = q[3] * b - q[4] * d + q[5] * c + q[6] * a, z = q[3] * d + q[4] * b - q[5] * a + q[6] * c;
    const float k = 1.0f / sqrtf(w * w + i * i + y * y + z * z);
    q[3] = w * k, q[4] = i * k, q[5] = y * k, q[6] = z * k;
}

// What did not fit into the buffers: see MuJoCo Warp's OverflowType.
if (part > 0) return;
const int rows = in.nefc.data[world];
int lost = 0;
if (rows > in.njmax) {
    lost |= NEFC;
} else if (SPARSE && rows > 0) {
    const size_t last = (size_t)world * in.efc_J_rownnz.shape[1] + rows - 1;
    if (in.efc_J_rowadr.data[last] + in.efc_J_rownnz.data[last] > in.njmax_nnz) lost |= NJMAX_NNZ;
}
if (in.ncollision.data[0] > in.naconmax) lost |= BROADPHASE;
if (in.nacon.data[0] > in.naconmax) lost |= NARROWPHASE;
if (lost) in.overflow.data[world] |= lost;
