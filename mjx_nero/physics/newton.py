"""MuJoCo's Newton solver for constraint forces, as one GPU kernel.

MuJoCo Warp solves with a dozen kernels an iteration, each for all environments, until the slowest of them has converged: at
thousands of environments that is most of a step that grasps. Here a warp of 32 threads takes one environment from beginning to
end, in shared memory. The problem is MuJoCo's own (mujoco.readthedocs.io, Computation, "Primal problem": the accelerations that
minimise Gauss' cost and the constraints' cost, with elliptic or pyramidal friction cones), so the solution is, too.

The same source compiles for the CPU, with one thread for all 32: slow, for tests.
"""

from collections.abc import Callable

import mujoco

_SHARED_BYTES = 48 * 1024  # of a block, on every GPU that Warp supports

# One environment: a <- argmin  1/2 (a - smooth)' M (a - smooth) + s(J a - aref).
# Names: NV degrees of freedom, NJ rows at most, r = J a - aref, f = -s'(r), p the search direction, W = s''(r) J.
_SOLVE = """
#if defined(__CUDA_ARCH__)
    const int lane = threadIdx.x % 32, lanes = 32;
    __shared__ float pool[WORLDS * SIZE];
    float* s = pool + threadIdx.x / 32 * SIZE;
    auto sync = [] { __syncwarp(); };
    auto sum = [](float x) {
        for (int offset = 16; offset; offset >>= 1) x += __shfl_xor_sync(0xffffffff, x, offset);
        return x;
    };
#else
    const int lane = 0, lanes = 1;
    float s[SIZE];
    auto sync = [] {};
    auto sum = [](float x) { return x; };
#endif
    const int world = tid / lanes, n = nefc.data[world] < NJ ? nefc.data[world] : NJ;
    const int equalities = ne.data[world], bilateral = equalities + nf.data[world];
    const float* J = efc_J.data + (size_t)world * efc_J.shape[1] * efc_J.shape[2];
    const int stride = efc_J.shape[2];
    const float* D = efc_D.data + (size_t)world * efc_D.shape[1];
    const float* aref = efc_aref.data + (size_t)world * efc_aref.shape[1];
    const float* loss = efc_frictionloss.data + (size_t)world * efc_frictionloss.shape[1];
    const int* type = efc_type.data + (size_t)world * efc_type.shape[1];
    const int* id = efc_id.data + (size_t)world * efc_id.shape[1];
    const float* packed = M_in.data + (size_t)world * M_in.shape[1];
    const float* smooth = qfrc_smooth.data + world * NV;
    const float shrink = impratio_invsqrt.data[world % impratio_invsqrt.shape[0]];
    const float limit = tolerance.data[world % tolerance.shape[0]], ls_limit = ls_tolerance.data[world % ls_tolerance.shape[0]];

    float *M = s, *H = M + NV * NV, *W = H + NV * NV;
    float *a = W + NJ * NV, *p = a + NV, *g = p + NV, *Ma = g + NV, *Mp = Ma + NV, *r = Mp + NV, *Jp = r + NJ, *f = Jp + NJ;

    for (int i = lane; i < NV * NV; i += lanes) M[i] = 0.0f;
    sync();
    for (int i = lane; i < NV; i += lanes) {
        a[i] = n ? warmstart.data[world * NV + i] : qacc_smooth.data[world * NV + i];
        for (int k = M_rowadr.data[i]; k < M_rowadr.data[i] + M_rownnz.data[i]; ++k) {
            const int j = M_colind.data[k];
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
            for (int j = 0; j < NV; ++j) total += J[row * stride + j] * x[j];
            z[row] = total;
        }
        sync();
    };
    // A contact with an elliptic cone is its first row's: friction of its other rows, their number with the first; else 0.
    auto cone = [&](int row, const float*& friction) {
        if (type[row] != ELLIPTIC) return 0;
        const int contact = id[row];
        friction = (const float*)(contact_friction.data + contact);
        return contact_efc_address.data[contact * contact_efc_address.shape[1]] == row ? contact_dim.data[contact] : -1;
    };
    // First and second derivative of a row's cost that is not a cone's, by its own residual x.
    auto simple = [&](int row, float x, float& first, float& second) {
        first = D[row] * x, second = D[row];
        if (row < equalities) return;
        if (row < bilateral) {
            if (fabsf(first) >= loss[row]) first = x < 0.0f ? -loss[row] : loss[row], second = 0.0f;
        } else if (x >= 0.0f) {
            first = second = 0.0f;
        }
    };
    // Derivatives of the whole cost along p at the step t: the sums of what the lanes hold.
    auto slope = [&](float t, float& first, float& second) {
        first = second = 0.0f;
        for (int row = lane; row < n; row += lanes) {
            const float* friction;
            const int dim = cone(row, friction);
            if (dim < 0) continue;
            float d1, d2;
            if (dim == 0) {
                simple(row, r[row] + t * Jp[row], d1, d2);
                first += d1 * Jp[row], second += d2 * Jp[row] * Jp[row];
                continue;
            }
            const float mu = friction[0] * shrink, N = mu * (r[row] + t * Jp[row]), dN = mu * Jp[row];
            float TT = 0.0f, UV = 0.0f, VV = 0.0f;
            for (int j = 1; j < dim; ++j) {
                const float U = friction[j - 1] * (r[row + j] + t * Jp[row + j]), V = friction[j - 1] * Jp[row + j];
                TT += U * U, UV += U * V, VV += V * V;
            }
            const float T = sqrtf(TT);
            if (N >= mu * T) continue;
            if (mu * N + T <= 0.0f) {
                for (int j = 0; j < dim; ++j) {
                    const float weight = D[row + j] * Jp[row + j];
                    first += weight * (r[row + j] + t * Jp[row + j]), second += weight * Jp[row + j];
                }
                continue;
            }
            const float Dm = D[row] / (mu * mu * (1.0f + mu * mu)), gap = N - mu * T, dT = UV / T, dgap = dN - mu * dT;
            first += Dm * gap * dgap, second += Dm * (dgap * dgap - gap * mu * (VV - dT * dT) / T);
        }
        first = sum(first), second = sum(second);
    };

    multiply(a, Ma, r, aref);
    int iteration = 0;
    while (iteration < iterations && n) {
        // f and W
        for (int row = lane; row < n; row += lanes) {
            const float* friction;
            const int dim = cone(row, friction);
            if (dim < 0) continue;
            if (dim == 0) {
                float d1, d2;
                simple(row, r[row], d1, d2);
                f[row] = -d1;
                for (int j = 0; j < NV; ++j) W[row * NV + j] = d2 * J[row * stride + j];
                continue;
            }
            const float mu = friction[0] * shrink, N = mu * r[row];
            float TT = 0.0f;
            for (int j = 1; j < dim; ++j) TT += friction[j - 1] * r[row + j] * friction[j - 1] * r[row + j];
            const float T = sqrtf(TT);
            if (N >= mu * T || mu * N + T <= 0.0f) {  // apart, or sticking
                for (int k = 0; k < dim; ++k) {
                    const float weight = N >= mu * T ? 0.0f : D[row + k];
                    f[row + k] = -weight * r[row + k];
                    for (int j = 0; j < NV; ++j) W[(row + k) * NV + j] = weight * J[(row + k) * stride + j];
                }
                continue;
            }
            const float Dm = D[row] / (mu * mu * (1.0f + mu * mu)), ratio = mu * N / T;
            f[row] = -Dm * (N - mu * T) * mu;
            for (int k = 1; k < dim; ++k) f[row + k] = -f[row] / T * friction[k - 1] * friction[k - 1] * r[row + k];
            for (int j = 0; j < NV; ++j) {
                const float normal = mu * J[row * stride + j];
                float along = 0.0f;  // the direction in which it slides
                for (int k = 1; k < dim; ++k) {
                    along += friction[k - 1] * friction[k - 1] * r[row + k] * J[(row + k) * stride + j];
                }
                along /= T;
                W[row * NV + j] = Dm * mu * (normal - mu * along);
                for (int k = 1; k < dim; ++k) {
                    const float u = friction[k - 1] * r[row + k] / T, tangent = friction[k - 1] * J[(row + k) * stride + j];
                    W[(row + k) * NV + j] =
                        Dm * friction[k - 1] * (u * (ratio * along - mu * normal) + (mu * mu - ratio) * tangent);
                }
            }
        }
        sync();
        // gradient g and Hessian H (its lower triangle)
        float gg = 0.0f;
        for (int i = lane; i < NV; i += lanes) {
            float total = Ma[i] - smooth[i];
            for (int row = 0; row < n; ++row) total -= J[row * stride + i] * f[row];
            g[i] = total, p[i] = -total;
            gg += total * total;
        }
        for (int e = lane; e < NV * (NV + 1) / 2; e += lanes) {
            int i = (int)((sqrtf(8.0f * e + 1.0f) - 1.0f) / 2.0f);
            i += (i + 1) * (i + 2) / 2 <= e;
            const int j = e - i * (i + 1) / 2;
            float total = M[i * NV + j];
            for (int row = 0; row < n; ++row) total += J[row * stride + i] * W[row * NV + j];
            H[i * NV + j] = total;
        }
        sync();
        if (scale * sqrtf(sum(gg)) < limit) break;
        // H = L L', then p = -H^-1 g
        for (int k = 0; k < NV; ++k) {
            const float pivot = sqrtf(H[k * NV + k] > 1e-15f ? H[k * NV + k] : 1e-15f);
            sync();
            for (int i = k + lane; i < NV; i += lanes) H[i * NV + k] = i == k ? pivot : H[i * NV + k] / pivot;
            sync();
            for (int e = lane; e < (NV - k - 1) * (NV - k - 1); e += lanes) {
                const int i = k + 1 + e / (NV - k - 1), j = k + 1 + e % (NV - k - 1);
                if (j <= i) H[i * NV + j] -= H[i * NV + k] * H[j * NV + k];
            }
            sync();
        }
        for (int k = 0; k < NV; ++k) {
            const float x = p[k] / H[k * NV + k];
            sync();
            for (int i = k + lane; i < NV; i += lanes) p[i] = i == k ? x : p[i] - H[i * NV + k] * x;
            sync();
        }
        for (int k = NV - 1; k >= 0; --k) {
            const float x = p[k] / H[k * NV + k];
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
        for (int k = 0; k < ls_iterations; ++k) {
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
    for (int i = lane; i < NV; i += lanes) qacc.data[world * NV + i] = a[i], efc_Ma.data[world * NV + i] = Ma[i];
    if (lane == 0) solver_niter.data[world] = iteration;
"""


def make(model, data) -> Callable[[], None]:
    """What puts the solution into ``data.qacc`` and ``data.efc.Ma``, all that MuJoCo Warp's integrators read of it.

    Args:
        model, data: MuJoCo Warp's, with dense Jacobians.
    """
    import warp as wp

    nv, njmax = model.nv, data.njmax
    size = 2 * nv * nv + njmax * nv + 5 * nv + 3 * njmax
    worlds = max(1, min(4, _SHARED_BYTES // (4 * size)))
    numbers = {
        "NV": nv,
        "NJ": njmax,
        "SIZE": size,
        "WORLDS": worlds,
        "ELLIPTIC": int(mujoco.mjtConstraint.mjCNSTR_CONTACT_ELLIPTIC),
    }
    source = "".join(f"constexpr int {name} = {value};\n" for name, value in numbers.items()) + _SOLVE
    ints, floats, rows = wp.array(dtype=int), wp.array(dtype=float), wp.array(dtype=float, ndim=2)
    int_rows, vec5 = wp.array(dtype=int, ndim=2), wp.array(dtype=data.contact.friction.dtype)

    @wp.func_native(source)
    def solve(
        tid: int,
        nefc: ints,
        ne: ints,
        nf: ints,
        efc_J: wp.array(dtype=float, ndim=3),
        efc_D: rows,
        efc_aref: rows,
        efc_frictionloss: rows,
        efc_type: int_rows,
        efc_id: int_rows,
        contact_friction: vec5,
        contact_dim: ints,
        contact_efc_address: int_rows,
        M_rownnz: ints,
        M_rowadr: ints,
        M_colind: ints,
        M_in: rows,
        qfrc_smooth: rows,
        qacc_smooth: rows,
        warmstart: rows,
        impratio_invsqrt: floats,
        tolerance: floats,
        ls_tolerance: floats,
        iterations: int,
        ls_iterations: int,
        qacc: rows,
        efc_Ma: rows,
        solver_niter: ints,
    ): ...

    @wp.kernel(module="unique", enable_backward=False)
    def newton(
        nefc: ints,
        ne: ints,
        nf: ints,
        efc_J: wp.array(dtype=float, ndim=3),
        efc_D: rows,
        efc_aref: rows,
        efc_frictionloss: rows,
        efc_type: int_rows,
        efc_id: int_rows,
        contact_friction: vec5,
        contact_dim: ints,
        contact_efc_address: int_rows,
        M_rownnz: ints,
        M_rowadr: ints,
        M_colind: ints,
        M_in: rows,
        qfrc_smooth: rows,
        qacc_smooth: rows,
        warmstart: rows,
        impratio_invsqrt: floats,
        tolerance: floats,
        ls_tolerance: floats,
        iterations: int,
        ls_iterations: int,
        qacc: rows,
        efc_Ma: rows,
        solver_niter: ints,
    ):
        solve(
            wp.tid(),
            nefc,
            ne,
            nf,
            efc_J,
            efc_D,
            efc_aref,
            efc_frictionloss,
            efc_type,
            efc_id,
            contact_friction,
            contact_dim,
            contact_efc_address,
            M_rownnz,
            M_rowadr,
            M_colind,
            M_in,
            qfrc_smooth,
            qacc_smooth,
            warmstart,
            impratio_invsqrt,
            tolerance,
            ls_tolerance,
            iterations,
            ls_iterations,
            qacc,
            efc_Ma,
            solver_niter,
        )

    efc, contact, opt = data.efc, data.contact, model.opt
    inputs = [data.nefc, data.ne, data.nf, efc.J, efc.D, efc.aref, efc.frictionloss, efc.type, efc.id]
    inputs += [contact.friction, contact.dim, contact.efc_address, model.M_rownnz, model.M_rowadr, model.M_colind, data.M]
    inputs += [data.qfrc_smooth, data.qacc_smooth, data.qacc_warmstart, opt.impratio_invsqrt, opt.tolerance, opt.ls_tolerance]
    inputs += [opt.iterations, opt.ls_iterations]
    threads = 32 if wp.get_device().is_cuda else 1

    def run():
        outputs = [data.qacc, efc.Ma, data.solver_niter]
        wp.launch(newton, dim=data.nworld * threads, inputs=inputs, outputs=outputs, block_dim=threads * worlds)

    return run
