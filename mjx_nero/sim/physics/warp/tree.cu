// One tree of one environment, one thread: from positions, velocities and targets to all that does not depend on contacts. In MuJoCo's terms
// (mujoco.readthedocs.io, Computation, "Forward dynamics"): kinematics, the bias forces by recursive Newton-Euler (Featherstone,
// "Rigid Body Dynamics Algorithms", 5.3), the joint-space inertia M by composite rigid bodies (6.2), passive forces and drives.
//
// Bodies and degrees of freedom have MuJoCo's order: parents before children. A row of M has the columns of the degrees of freedom
// between the root of the tree and its own. Spatial vectors are (angular, linear), in the world's axes about the first joint of the
// tree: MuJoCo takes its centre of mass, and whoever reads ``subtree_com`` only asks what ``cdof`` is about.
//
// The body of a function of (tid, problem) that dynamics.py compiles, after the model's sizes and tables.

const int worlds = problem.qpos.shape[0], world = tid % worlds, part = tid / worlds;
const int first_body = PART[part], last_body = PART[part + 1] - 1;
const int first_joint = FIRST_JOINT[first_body], end_joint = FIRST_JOINT[last_body + 1];
const int first_dof = FIRST_DOF[first_body], end_dof = FIRST_DOF[last_body + 1];
struct V {
    float x, y, z;
    CUDA_CALLABLE V operator+(V b) const { return {x + b.x, y + b.y, z + b.z}; }
    CUDA_CALLABLE V operator-(V b) const { return {x - b.x, y - b.y, z - b.z}; }
    CUDA_CALLABLE V operator*(float k) const { return {x * k, y * k, z * k}; }
};
struct Q {  // w first
    float w;
    V v;
};
struct S {
    V a, l;
    CUDA_CALLABLE S operator+(S b) const { return {a + b.a, l + b.l}; }
    CUDA_CALLABLE S operator*(float k) const { return {a * k, l * k}; }
};
struct I {  // a body's or several bodies' inertia: of rotation, xx yy zz xy xz yz, mass times position, mass
    float r[6];
    V h;
    float m;
};
auto dot = [](V a, V b) { return a.x * b.x + a.y * b.y + a.z * b.z; };
auto cross = [](V a, V b) { return V{a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}; };
auto times = [&](Q a, Q b) { return Q{a.w * b.w - dot(a.v, b.v), b.v * a.w + a.v * b.w + cross(a.v, b.v)}; };
auto unit = [&](Q q) {
    const float k = 1.0f / sqrtf(q.w * q.w + dot(q.v, q.v));
    return Q{q.w * k, q.v * k};
};
auto rotate = [&](Q q, V u) {
    const V t = cross(q.v, u) * 2.0f;
    return u + t * q.w + cross(q.v, t);
};
struct R {  // a rotation's columns: where x, y and z go
    V x, y, z;
};
auto matrix = [&](Q q) { return R{rotate(q, {1, 0, 0}), rotate(q, {0, 1, 0}), rotate(q, {0, 0, 1})}; };
auto momentum = [&](const I& i, S v) {
    const float* r = i.r;
    const V spin = {r[0] * v.a.x + r[3] * v.a.y + r[4] * v.a.z, r[3] * v.a.x + r[1] * v.a.y + r[5] * v.a.z,
                    r[4] * v.a.x + r[5] * v.a.y + r[2] * v.a.z};
    return S{spin + cross(i.h, v.l), v.l * i.m - cross(i.h, v.a)};
};
auto sum = [](I a, const I& b) {
    for (int k = 0; k < 6; ++k) a.r[k] += b.r[k];
    a.h = a.h + b.h, a.m += b.m;
    return a;
};
auto moved = [&](S v, S axis) { return S{cross(v.a, axis.a), cross(v.a, axis.l) + cross(v.l, axis.a)}; };  // d axis / dt
auto pressed = [&](S v, S p) { return S{cross(v.a, p.a) + cross(v.l, p.l), cross(v.a, p.l)}; };            // d p / dt
auto along = [&](S axis, S force) { return dot(axis.a, force.a) + dot(axis.l, force.l); };

const auto& in = problem;
// The row of this environment, of a field that may differ from one to another.
auto of = [&](const auto& field) {
    return (const float*)((const char*)field.data + (size_t)(world % field.shape[0]) * field.strides[0]);
};
auto vector = [](const float* row, int i) { return V{row[3 * i], row[3 * i + 1], row[3 * i + 2]}; };
auto quaternion = [](const float* row, int i) { return Q{row[4 * i], {row[4 * i + 1], row[4 * i + 2], row[4 * i + 3]}}; };
auto within = [](float x, const float* range) { return x < range[0] ? range[0] : x > range[1] ? range[1] : x; };
auto put = [](float* to, V v) { to[0] = v.x, to[1] = v.y, to[2] = v.z; };
auto put_matrix = [](float* to, R m) {
    to[0] = m.x.x, to[1] = m.y.x, to[2] = m.z.x, to[3] = m.x.y, to[4] = m.y.y, to[5] = m.z.y, to[6] = m.x.z, to[7] = m.y.z;
    to[8] = m.z.z;
};
const float *qpos = in.qpos.data + (size_t)world * NQ, *qvel = in.qvel.data + (size_t)world * NV;
const float h = in.timestep.data[world % in.timestep.shape[0]];

// From the roots to the leaves: where bodies are, how they move, the accelerations that this and gravity cause, and the forces which
// that takes. Chains are long, so a body's state stays in registers for the next one; others look it up.
const int world_body = first_body - 1, first_entry = ROW[first_dof];  // the body stands for the world that the tree stands on
#define OWN(type, name, size, first) type own_##name[size], *const name = own_##name - (first)  // one tree's, at the model's indices
OWN(V, at, BODIES, world_body);
OWN(Q, turned, BODIES, world_body);
OWN(I, inertia, BODIES, world_body);
OWN(S, velocity, BODIES, world_body);
OWN(S, acceleration, BODIES, world_body);
OWN(S, force, BODIES, world_body);
OWN(S, dof, DOFS, first_dof);
{
    const float *body_pos = of(in.body_pos), *body_quat = of(in.body_quat), *body_ipos = of(in.body_ipos);
    const float *body_iquat = of(in.body_iquat), *body_mass = of(in.body_mass), *body_inertia = of(in.body_inertia);
    const float *gravcomp = of(in.body_gravcomp), *gravity = (const float*)(in.gravity.data + world % in.gravity.shape[0]);
    const float *jnt_pos = of(in.jnt_pos), *jnt_axis = of(in.jnt_axis), *qpos0 = of(in.qpos0);
    const float *mocap_pos = of(in.mocap_pos), *mocap_quat = of(in.mocap_quat), *geom_pos = of(in.geom_pos);
    const float* geom_quat = of(in.geom_quat);
    const V down = {gravity[0], gravity[1], gravity[2]};
    V x = at[world_body] = {0, 0, 0}, origin = x;
    Q q = turned[world_body] = {1, {0, 0, 0}};
    S v = velocity[world_body] = {{0, 0, 0}, {0, 0, 0}}, a = acceleration[world_body] = {{0, 0, 0}, down * -1.0f};
#pragma unroll 1  // here and below: unrolled, the whole tree would not fit the instruction cache
    for (int b = first_body; b <= last_body; ++b) {
        const int p = PARENT[b];
        if (p != b - 1) x = at[p], q = turned[p], v = velocity[p], a = acceleration[p];
        x = x + rotate(q, MOCAP[b] < 0 ? vector(body_pos, b) : vector(mocap_pos, MOCAP[b]));
        q = times(q, MOCAP[b] < 0 ? quaternion(body_quat, b) : quaternion(mocap_quat, MOCAP[b]));
        auto move = [&](int i, S way, S change) {
            dof[i] = way, a = a + change * qvel[i];
            if (!LINKS) return;
            float* to = (float*)(in.cdof_dot.data + (size_t)world * NV + i);
            put(to, change.a), put(to + 3, change.l);
        };
        bool begins = ROOT[b] == b;
#pragma unroll 1
        for (int j = FIRST_JOINT[b]; j < FIRST_JOINT[b + 1]; ++j) {
            const float* value = qpos + QPOS[j];
            const int i = DOF[j];
            const V offset = vector(jnt_pos, j), local = vector(jnt_axis, j);
            if (TYPE[j] == FREE) {
                x = vector(value, 0), q = unit(Q{value[3], {value[4], value[5], value[6]}});
                origin = x, begins = false;
                const R ways = matrix(q);
                const S none = {{0, 0, 0}, {0, 0, 0}}, rx = {ways.x, {0, 0, 0}}, ry = {ways.y, {0, 0, 0}}, rz = {ways.z, {0, 0, 0}};
                move(i, {{0, 0, 0}, {1, 0, 0}}, none), move(i + 1, {{0, 0, 0}, {0, 1, 0}}, none);
                move(i + 2, {{0, 0, 0}, {0, 0, 1}}, none);
                v.l = v.l + V{qvel[i], qvel[i + 1], qvel[i + 2]};
                move(i + 3, rx, moved(v, rx)), move(i + 4, ry, moved(v, ry)), move(i + 5, rz, moved(v, rz));
                v = v + rx * qvel[i + 3] + ry * qvel[i + 4] + rz * qvel[i + 5];
                continue;
            }
            const V anchor = x + rotate(q, offset), axis = rotate(q, local);
            if (begins) origin = anchor, begins = false;
            const float by = *value - qpos0[QPOS[j]];
            if (TYPE[j] == SLIDE) {
                x = x + axis * by;
            } else {
                q = times(q, Q{cosf(0.5f * by), local * sinf(0.5f * by)});
                x = anchor - rotate(q, offset);
            }
            const S way = TYPE[j] == SLIDE ? S{{0, 0, 0}, axis} : S{axis, cross(axis, origin - anchor)};
            move(i, way, moved(v, way));
            v = v + way * qvel[i];
        }
        if (begins) origin = x;
        q = unit(q);
        at[b] = x, turned[b] = q, velocity[b] = v, acceleration[b] = a;
        if (ROOT[b] == b) put((float*)(in.subtree_com.data + (size_t)world * NB + b), origin);
#pragma unroll 1
        for (int g = FIRST_GEOM[b]; g < FIRST_GEOM[b + 1]; ++g) {
            if (STANDS[g]) continue;
            put((float*)(in.geom_xpos.data + (size_t)world * NG + g), x + rotate(q, vector(geom_pos, g)));
            put_matrix((float*)(in.geom_xmat.data + (size_t)world * NG + g), matrix(times(q, quaternion(geom_quat, g))));
        }
        const V away = x + rotate(q, vector(body_ipos, b)) - origin, diagonal = vector(body_inertia, b);
        const R frame = matrix(times(q, quaternion(body_iquat, b)));
        const float m = body_mass[b], square = m * dot(away, away);
        auto about = [&](float V::*i, float V::*j) {
            return diagonal.x * frame.x.*i * frame.x.*j + diagonal.y * frame.y.*i * frame.y.*j + diagonal.z * frame.z.*i * frame.z.*j -
                   m * away.*i * away.*j;
        };
        const I own = {{about(&V::x, &V::x) + square, about(&V::y, &V::y) + square, about(&V::z, &V::z) + square, about(&V::x, &V::y),
                        about(&V::x, &V::z), about(&V::y, &V::z)},
                       away * m,
                       m};
        S f = momentum(own, a) + pressed(v, momentum(own, v));
        if (GRAVCOMP && gravcomp[b] != 0.0f) {  // lifts the body at its centre of mass
            const V lift = down * (-m * gravcomp[b]);
            f = f + S{cross(away, lift), lift} * -1.0f;
        }
        inertia[b] = own, force[b] = f;
        if (!LINKS) continue;
        float *speed = (float*)(in.cvel.data + (size_t)world * NB + b), *quat = (float*)(in.xquat.data + (size_t)world * NB + b);
        put(speed, v.a), put(speed + 3, v.l), quat[0] = q.w, put(quat + 1, q.v);
        put((float*)(in.xpos.data + (size_t)world * NB + b), x);
        put_matrix((float*)(in.xmat.data + (size_t)world * NB + b), matrix(q));
    }
}

// From the leaves to the roots: forces and inertias of all that a joint carries. ``implicit`` is -d smooth / d velocity.
OWN(float, M, ENTRIES, first_entry);
OWN(float, smooth, DOFS, first_dof);
OWN(float, implicit, DOFS, first_dof);
{
    const float *armature = of(in.dof_armature), *damping = of(in.dof_damping), *curve = of(in.dof_dampingpoly);
    const float *stiffness = of(in.jnt_stiffness), *stiffening = of(in.jnt_stiffnesspoly), *rest = of(in.qpos_spring);
    S f = force[last_body];
    I carried = inertia[last_body];
#pragma unroll 1
    for (int b = last_body; b >= first_body; --b) {
#pragma unroll 1
        for (int i = FIRST_DOF[b + 1] - 1; i >= FIRST_DOF[b]; --i) {
            const S along_it = momentum(carried, dof[i]);
            const int begin = ROW[i], n = ROW[i + 1] - begin;
#pragma unroll 2
            for (int k = 0; k < n; ++k) M[begin + k] = along(dof[COLUMN[begin + k]], along_it);
            M[begin + n - 1] += armature[i];
            // A damper's force is -v (d + d1 |v| + d2 v^2).
            const float speed = fabsf(qvel[i]), d = damping[i], d1 = curve[2 * i], d2 = curve[2 * i + 1];
            smooth[i] = -along(dof[i], f) - qvel[i] * (d + (d1 + d2 * speed) * speed);
            implicit[i] = d + (2.0f * d1 + 3.0f * d2 * speed) * speed;
        }
        if (FREE_AT[b] >= 0) inertia[b] = carried;
        const int p = PARENT[b];
        const S below = f;
        const I lower = carried;
        f = force[b - 1], carried = inertia[b - 1];
        if (p == b - 1) f = f + below, carried = sum(carried, lower);
        else if (p > world_body) force[p] = force[p] + below, inertia[p] = sum(inertia[p], lower);
    }
#pragma unroll 1
    for (int j = first_joint; j < end_joint; ++j) {
        if (TYPE[j] == FREE) continue;  // dynamics.py: has none
        const float x = qpos[QPOS[j]] - rest[QPOS[j]];
        smooth[DOF[j]] -= x * (stiffness[j] + (stiffening[2 * j] + stiffening[2 * j + 1] * x) * x);
    }
}

// Drives: gain u + b0 + b1 length + b2 speed, within what they can do.
{
    const float *ctrl = in.ctrl.data + (size_t)world * in.ctrl.shape[1], *gain = of(in.actuator_gainprm), *bias = of(in.actuator_biasprm);
    const float *gear = of(in.actuator_gear), *most = of(in.actuator_forcerange), *reach = of(in.actuator_ctrlrange);
    OWN(float, driven, DOFS, first_dof);
    OWN(float, slope, DOFS, first_dof);
    for (int i = first_dof; i < end_dof; ++i) driven[i] = slope[i] = 0.0f;
#pragma unroll 1
    for (int u = 0; u < NU; ++u) {
        const int j = JOINT_OF_DRIVE[u], i = DOF[j];
        if (j < first_joint || j >= end_joint) continue;
        const float g = gear[6 * u], *b = bias + 10 * u, target = CTRL_LIMITED[u] ? within(ctrl[u], reach + 2 * u) : ctrl[u];
        float f = gain[10 * u] * target, df = 0.0f;
        if (AFFINE[u]) f += b[0] + (b[1] * qpos[QPOS[j]] + b[2] * qvel[i]) * g, df = b[2];
        if (FORCE_LIMITED[u]) f = within(f, most + 2 * u);
        if (FORCE_LIMITED[u] && (f == most[2 * u] || f == most[2 * u + 1])) df = 0.0f;
        driven[i] += g * f, slope[i] += g * g * df;
    }
    const float* joint_most = of(in.jnt_actfrcrange);
#pragma unroll 1
    for (int j = first_joint; j < end_joint; ++j) {
        const int i = DOF[j];
        if (!JOINT_LIMITED[j]) continue;
        const float f = within(driven[i], joint_most + 2 * j);
        if (f != driven[i]) driven[i] = f, slope[i] = 0.0f;
    }
    for (int i = first_dof; i < end_dof; ++i) smooth[i] += driven[i], implicit[i] -= slope[i];
}

for (int k = first_entry; k < ROW[end_dof]; ++k) in.M.data[(size_t)world * in.M.shape[1] + k] = M[k];
for (int i = first_dof; i < end_dof; ++i) {
    in.qfrc_smooth.data[(size_t)world * NV + i] = smooth[i], in.implicit.data[(size_t)world * NV + i] = implicit[i];
    float* to = (float*)(in.cdof.data + (size_t)world * NV + i);
    put(to, dof[i].a), put(to + 3, dof[i].l);
}

// The bias force of a body that flies freely, by its angular velocity w about its own axes: the columns of linear and angular part.
// With s from its origin to its centre of mass, J its inertia about that and u an axis,
//     d linear  = -m K u,  K u = s (w.u) - u (w.s) + (w x s) x u
//     d angular = -m s x K u + w x J u - J w x u
#pragma unroll 1
for (int f = 0; f < NFREE; ++f) {
    const int b = FREE_BODY[f], i = FIRST_DOF[b];
    if (b < first_body || b > last_body) continue;
    const R ways = matrix(turned[b]);
    const float m = inertia[b].m;
    const V s = inertia[b].h * (1.0f / m), w = ways.x * qvel[i + 3] + ways.y * qvel[i + 4] + ways.z * qvel[i + 5], ws = cross(w, s);
    I spinning = inertia[b];  // about the centre of mass
    const float* r = inertia[b].r;
    const float square = m * dot(s, s);
    spinning.r[0] = r[0] - square + m * s.x * s.x, spinning.r[1] = r[1] - square + m * s.y * s.y;
    spinning.r[2] = r[2] - square + m * s.z * s.z, spinning.r[3] = r[3] + m * s.x * s.y;
    spinning.r[4] = r[4] + m * s.x * s.z, spinning.r[5] = r[5] + m * s.y * s.z;
    spinning.h = {0, 0, 0}, spinning.m = 0.0f;
    auto spun = [&](V u) { return momentum(spinning, {u, {0, 0, 0}}).a; };
    const V Jw = spun(w);
    float* to = in.spin.data + (size_t)world * in.spin.shape[1] + 18 * f;
    auto column = [&](int c, V u) {
        const V Ku = s * dot(w, u) - u * dot(w, s) + cross(ws, u);
        const V turning = cross(w, spun(u)) - cross(Jw, u) - cross(s, Ku) * m;
        const float entries[6] = {-m * Ku.x, -m * Ku.y, -m * Ku.z, dot(ways.x, turning), dot(ways.y, turning), dot(ways.z, turning)};
        for (int r = 0; r < 6; ++r) to[3 * r + c] = entries[r];
    };
    column(0, ways.x), column(1, ways.y), column(2, ways.z);
}
