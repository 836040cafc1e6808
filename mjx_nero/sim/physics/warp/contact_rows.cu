// One contact, a few threads: its rows of J, and for each of them the stiffness D and the acceleration aref that it asks for
// (mujoco.readthedocs.io, Computation, "Constraint model" and "Solver parameters"). With the first body's and the second body's
// velocities v1, v2 and spins w1, w2 at the contact, the normal n and the tangents s, t, row by row
//
//     J qvel = n (v2 - v1), s (v2 - v1), t (v2 - v1), n (w2 - w1), s (w2 - w1), t (w2 - w1)
//     aref = -b J qvel - k imp gap (the normal's), -b J qvel (the others'),   D = imp / ((1 - imp) A),  A by the bodies' invweight
//
// A pyramid has the normal plus and minus friction times each of the others in place of them.
//
// The body of a function of (tid, problem) that contact_rows.py compiles, after its constants.

const auto& in = problem;
#if defined(__CUDA_ARCH__)
#define UNROLLED _Pragma("unroll")  // keeps an array in registers
constexpr int lanes = LANES;
const int lane = threadIdx.x % lanes, mates = ((1 << lanes) - 1) << threadIdx.x % 32 / lanes * lanes;  // others may have returned
auto taken = [&](int* counter, int n) { return lane == 0 ? atomicAdd(counter, n) : 0; };  // of all lanes: see ``told``
auto told = [&](int x) { return __shfl_sync(mates, x, 0, lanes); };
auto sum = [&](float x) {
    for (int offset = lanes / 2; offset; offset >>= 1) x += __shfl_xor_sync(mates, x, offset);
    return x;
};
auto mark = [](int* flags, int flag) { atomicOr(flags, flag); };
auto count = [](unsigned long long x) { return __popcll(x); };
auto lowest = [](unsigned long long x) { return __ffsll(x) - 1; };
#else
#define UNROLLED
constexpr int lanes = 1;
const int lane = 0;
auto taken = [](int* counter, int n) { return (*counter += n) - n; };
auto told = [](int x) { return x; };
auto sum = [](float x) { return x; };
auto mark = [](int* flags, int flag) { *flags |= flag; };
auto count = [](unsigned long long x) { return __builtin_popcountll(x); };
auto lowest = [](unsigned long long x) { return __builtin_ctzll(x); };
#endif
const int contact = tid / lanes;
if (contact >= in.nacon.data[0]) return;

// Memory answers late, so all that is known of the contact is asked for at once, and its places before they are needed.
const int world = in.contact_worldid.data[contact], dim = in.contact_dim.data[contact], type = in.contact_type.data[contact];
const float gap = in.contact_dist.data[contact] - in.contact_includemargin.data[contact];
const int *geoms = (const int*)(in.contact_geom.data + contact), geom = geoms[0], other_geom = geoms[1];
float pos[3], frame[9], friction[5], solref[2], other[2], solimp[5];  // rows of the frame: n, s, t
auto read = [&](float* to, const auto& array, int n) {
    for (int k = 0; k < n; ++k) to[k] = ((const float*)(array.data + contact))[k];
};
read(pos, in.contact_pos, 3), read(frame, in.contact_frame, 9), read(friction, in.contact_friction, 5);
read(solref, in.contact_solref, 2), read(other, in.contact_solreffriction, 2), read(solimp, in.contact_solimp, 5);
if (!(type & CONSTRAINT) || gap >= 0.0f) return;
auto moves = [](int geom) { return (unsigned long long)(unsigned)MOVES_HIGH[geom] << 32 | (unsigned)MOVES_LOW[geom]; };
const unsigned long long second = moves(other_geom), moved = moves(geom) ^ second;  // what moves both moves neither to the other
const bool pyramid = !ELLIPTIC && dim > 1;
const int rows = pyramid ? 2 * (dim - 1) : dim, filled = count(moved);
const int row = taken(in.nefc.data + world, rows), nonzero = SPARSE ? taken(in.nonzeros.data + world, rows * filled) : 0;

// How stiff, and how damped: MuJoCo's impedance imp at this gap, and its k and b.
const float h = in.timestep.data[world % in.timestep.shape[0]], least = 1e-15f;
auto within = [](float x, float low, float high) { return x < low ? low : x > high ? high : x; };
const float dmin = within(solimp[0], 1e-4f, 0.9999f), dmax = within(solimp[1], 1e-4f, 0.9999f), middle = within(solimp[3], 1e-4f, 0.9999f);
const float power = solimp[4] > 1.0f ? solimp[4] : 1.0f, x = -gap / (solimp[2] > least ? solimp[2] : least);
float imp = 0.5f * (dmin + dmax);
if (dmin != dmax && solimp[2] > least) {
    const float rise = x >= 1.0f     ? 1.0f
                       : power == 1.0f ? x
                       : x <= middle   ? powf(x, power) / powf(middle, power - 1.0f)
                                       : 1.0f - powf(1.0f - x, power) / powf(1.0f - middle, power - 1.0f);
    imp = within(dmin + rise * (dmax - dmin), dmin < dmax ? dmin : dmax, dmin < dmax ? dmax : dmin);
}
auto atleast = [&](float x) { return x > least ? x : least; };
auto seconds = [&](const float* solref) { return REFSAFE && solref[0] < 2.0f * h ? 2.0f * h : solref[0]; };
auto damping = [&](const float* solref) {
    return solref[1] <= 0.0f ? -solref[1] / atleast(dmax) : 2.0f / atleast(dmax * seconds(solref));
};
const float t = seconds(solref) * dmax * solref[1];
const float k_imp_gap = imp * gap * (solref[0] <= 0.0f ? -solref[0] / atleast(dmax * dmax) : 1.0f / atleast(t * t));
const float b = damping(solref), b_other = ELLIPTIC && (other[0] != 0.0f || other[1] != 0.0f) ? damping(other) : b;
const float* invweight = (const float*)((const char*)in.body_invweight0.data +
                                        (size_t)(world % in.body_invweight0.shape[0]) * in.body_invweight0.strides[0]);
const float shrink = in.impratio_invsqrt.data[world % in.impratio_invsqrt.shape[0]], mu = friction[0];
float A = invweight[2 * BODY[geom]] + invweight[2 * BODY[other_geom]];
if (pyramid) A = (A + mu * mu * A) * 2.0f * mu * mu * shrink * shrink;
const float D = 1.0f / atleast(A * (1.0f - imp) / imp);

const int begin = told(row), fit = NJ - begin < rows ? NJ - begin : rows;  // the rest is lost: integrate.cu
int* address = in.contact_efc_address.data + (size_t)contact * in.contact_efc_address.shape[1];
for (int k = lane; k < rows; k += lanes) address[k] = k < fit ? begin + k : -1;
auto at_row = [&](const auto& array) { return array.data + (size_t)world * array.shape[1] + begin; };

// The nonzeros of J have places of their own: after each other in a row, the rows after each other.
const int start = told(nonzero), columns = SPARSE ? filled : NV, apart = SPARSE ? filled : in.efc_J.shape[2];
const bool fits = !SPARSE || start + rows * filled <= in.njmax_nnz;
if (!fits) mark(in.overflow.data + world, NJMAX_NNZ);
const size_t first = (size_t)world * in.efc_J.shape[1] * in.efc_J.shape[2] + (SPARSE ? start : begin * apart);
float velocity[MOST] = {};
for (int e = lane; fits && e < columns; e += lanes) {
    unsigned long long left = moved;
    for (int k = 0; SPARSE && k < e; ++k) left &= left - 1;
    const int i = SPARSE ? lowest(left) : e;
    const float* axis = (const float*)(in.cdof.data + (size_t)world * NV + i);  // angular, linear
    const float* origin = (const float*)(in.subtree_com.data + (size_t)world * in.subtree_com.shape[1] + ROOT[i]);
    const float x = pos[0] - origin[0], y = pos[1] - origin[1], z = pos[2] - origin[2];
    const float sign = !(moved >> i & 1) ? 0.0f : second >> i & 1 ? 1.0f : -1.0f, speed = in.qvel.data[(size_t)world * NV + i];
    const float spin[3] = {sign * axis[0], sign * axis[1], sign * axis[2]};
    const float move[3] = {sign * axis[3] + spin[1] * z - spin[2] * y, sign * axis[4] + spin[2] * x - spin[0] * z,
                           sign * axis[5] + spin[0] * y - spin[1] * x};
    auto along = [&](int k) {
        const float *way = frame + 3 * (k % 3), *of = k < 3 ? move : spin;
        return way[0] * of[0] + way[1] * of[1] + way[2] * of[2];
    };
    const float normal = along(0);
    UNROLLED
    for (int k = 0; k < MOST; ++k) {
        if (k >= fit) break;
        const float entry = pyramid ? normal + (k % 2 ? -1 : 1) * friction[k / 2] * along(k / 2 + 1) : along(k);
        in.efc_J.data[first + k * apart + e] = entry, velocity[k] += entry * speed;
        if (SPARSE) in.efc_J_colind.data[first + k * apart + e] = i;
    }
}

float speeds[(MOST + lanes - 1) / lanes];  // J qvel of this thread's rows
UNROLLED
for (int k = 0; k < MOST; ++k) {
    const float v = sum(velocity[k]);
    if (k % lanes == lane) speeds[k / lanes] = v;
}
UNROLLED
for (int n = 0; n < (MOST + lanes - 1) / lanes; ++n) {
    const int k = n * lanes + lane;
    if (k >= fit) break;
    const bool side = ELLIPTIC && k > 0;
    const float ratio = side ? shrink * (k > 1 ? mu / ((const float*)(in.contact_friction.data + contact))[k - 1] : 1.0f) : 1.0f;
    at_row(in.efc_D)[k] = D / (ratio * ratio);
    at_row(in.efc_aref)[k] = side ? -b_other * speeds[n] : -b * speeds[n] - k_imp_gap;
    at_row(in.efc_frictionloss)[k] = 0.0f;
    at_row(in.efc_type)[k] = dim == 1 ? ALONE : ELLIPTIC ? IN_A_CONE : IN_A_PYRAMID;
    at_row(in.efc_id)[k] = contact;
    if (SPARSE) at_row(in.efc_J_rowadr)[k] = fits ? start + k * filled : 0, at_row(in.efc_J_rownnz)[k] = fits ? filled : 0;
}
