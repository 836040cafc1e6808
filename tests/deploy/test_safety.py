"""The layer between policy and driver: nothing that goes out is beyond a limit, and every fault ends in holding."""

import dataclasses
import functools

import arms
import numpy as np
import pytest

from mjx_nero.deploy import setup
from mjx_nero.deploy.arm import Feedback
from mjx_nero.deploy.fence import FenceCfg
from mjx_nero.deploy.guard import Guard
from mjx_nero.deploy.safety import Fault, Limits, Safety, SafetyCfg
from mjx_nero.errors import UserError
from mjx_nero.tasks import registry

ROBOTS = registry.list_robots()


@pytest.fixture(scope="module", params=ROBOTS)
def told(request):
    return arms.metadata(request.param)


@pytest.fixture(scope="module")
def so101():
    return arms.metadata("so_arm101")


def begun(told, cfg=setup.USUAL, fence=setup.USUAL_FENCE):
    safety = setup.safety_of(told, cfg, fence)
    home = safety.limits.home
    safety.begin(Feedback(0.0, home, np.zeros(len(home))), 0.0)
    return safety


def wild(limits, rng, count):
    """Targets as a policy might have them that has lost its mind: far, near, to and fro, at the ends, endless, none."""
    target, n = limits.home.copy(), len(limits.home)
    for i in range(count):
        if i % 50 == 0:
            mode, goal = rng.integers(7), rng.uniform(limits.lower - 0.5, limits.upper + 0.5)
        if mode == 1:
            goal = rng.uniform(limits.lower - 3, limits.upper + 3)
        elif mode == 2:
            goal = target + rng.normal(0, 0.05, n)
        elif mode == 3:
            goal = rng.normal(0, 10.0 ** rng.integers(-3, 12), n)
        elif mode == 4:
            goal = np.where(rng.random(n) < 0.5, limits.lower, limits.upper)
        elif mode == 5:
            goal = np.where(i % 7 < 3, limits.lower, limits.upper)
        elif mode == 6:
            goal = limits.home
        target = goal
        yield target


def violations(safety, before, commands):
    """How far the worst of some commands, one after another, is beyond each limit; all at most zero where none is."""
    limits, (position, velocity) = safety.limits, before
    path = np.array([position, *(c.position for c in commands)])
    speeds = np.diff(path, axis=0) / limits.dt
    changes = np.diff(np.array([velocity, *speeds]), axis=0) / limits.dt
    clear = safety._fence.clearance(path[1:])
    return {
        "range": max((limits.lower - path).max(), (path - limits.upper).max()),
        "speed": (np.abs(speeds) / limits.speed).max() - 1,
        "acceleration": (np.abs(changes) / limits.acceleration).max() - 1,
        "fence": -clear.min(),
    }


def fuzz(told, count, seed):
    safety, rng, commands, worst = (
        begun(told),
        np.random.default_rng(seed),
        [],
        dict.fromkeys(("range", "speed", "acceleration", "fence"), -1.0),
    )
    before = safety.position.copy(), safety.velocity.copy()
    for target in wild(safety.limits, rng, count):
        commands.append(safety.step(target))
        if len(commands) == 500:
            found = violations(safety, before, commands)
            worst = {name: max(worst[name], found[name]) for name in found}
            before, commands = (commands[-1].position, commands[-1].velocity), []
    return safety, worst


@pytest.mark.parametrize("seed", [0])
def test_wild_targets_never_get_beyond_a_limit(told, seed):
    safety, worst = fuzz(told, 1500, seed)
    assert safety.fault is None and max(worst.values()) < 1e-6, worst
    assert safety.counts["fence"] > 25 and safety.counts["joints"] > 250  # there was something to stop


def test_what_is_allowed_passes_unchanged(told):
    """A slow sine about home, within a box that is wide enough, is sent as it is."""
    safety = begun(told, fence=FenceCfg(table=-3.0, box=((-3, 3), (-3, 3), (-3, 3))))
    limits = safety.limits
    room = np.minimum(np.minimum(limits.upper - limits.home, limits.home - limits.lower), 0.05)
    for i in range(200):
        target = limits.home + room * (1 - np.cos(2 * np.pi * i / 200)) / 2 * 0.9
        np.testing.assert_allclose(safety.step(target).position, target, atol=1e-9)
    assert not safety.counts


def test_the_arm_slides_along_the_table(so101):
    """A target below the table is met as far as the table lets it."""
    safety = begun(so101)
    down = safety.limits.home.copy()
    down[1] += 0.9  # shoulder_lift: forward and down
    down[0] = 0.5
    for _ in range(300):
        command = safety.step(down)
    assert command.position[0] == pytest.approx(0.5, abs=0.05)  # it turned all the way
    assert "fence" in command.limited and "table" in safety.blocked_by
    assert 0 <= safety._fence.clearance(command.position[None]).min() < 0.01


@pytest.mark.parametrize(
    ("fence", "why"),
    [
        (FenceCfg(table=-1.0, box=((-1, 0.42), (-1, 1), (-1, 1))), "x from above"),
        (FenceCfg(table=0.1, box=((-1, 1), (-1, 1), (-1, 1))), "the table"),
    ],
)
def test_the_fence_is_where_it_is_said_to_be(so101, fence, why):
    safety = begun(so101, fence=fence)
    rng = np.random.default_rng(3)
    reasons, commands = set(), []
    for target in wild(safety.limits, rng, 1500):
        commands.append(safety.step(target))
        reasons.add(safety.blocked_by)
    assert any(why in reason for reason in reasons), reasons
    assert safety._fence.clearance(np.array([c.position for c in commands])).min() > -1e-6


def test_links_do_not_meet():
    told = arms.metadata("cobotta_pro_900")
    safety = begun(told, fence=FenceCfg(table=-3.0, box=((-3, 3), (-3, 3), (-3, 3))))
    reasons = set()
    for target in wild(safety.limits, np.random.default_rng(0), 1500):
        safety.step(target)
        reasons.add(safety.blocked_by)
    assert any(" and " in reason for reason in reasons), reasons


def test_an_arm_below_the_table_may_only_rise(so101):
    """Where the arm rests lower than the fence lets it, what makes it worse is refused and what makes it better is not."""
    safety = setup.safety_of(so101)
    low, lowered = safety.limits.home.copy(), np.linspace(0, 1.5, 100)
    depths = [safety._fence.clearance((low + [0, x, 0, 0, 0, 0])[None]).min() for x in lowered]
    low[1] += lowered[np.argmax(np.array(depths) < -0.02)]  # the shoulder lowers the arm until it is 2 cm too low
    safety.begin(Feedback(0.0, low, np.zeros(6)), 0.0, anywhere=True)
    deeper = low + np.array([0, 0.3, 0, 0, 0, 0])
    before = safety._fence.clearance(low[None])[0]
    for _ in range(20):
        q = safety.step(deeper).position
    assert (np.minimum(0, safety._fence.clearance(q[None])[0]) >= np.minimum(0, before) - 1e-6).all()
    for _ in range(200):
        q = safety.step(safety.limits.home).position
    np.testing.assert_allclose(q, safety.limits.home, atol=1e-3)


@functools.cache
def fence_of(robot):
    """It takes a while to make, and never changes."""
    return setup.safety_of(arms.metadata(robot))._fence


def guarded(told, **cfg):
    clock = arms.Clock()
    cfg = SafetyCfg(**cfg)
    safety = Safety(Limits.of(told, cfg), fence_of(told["robot"]), cfg)
    arm = arms.Ideal(safety.limits.names, safety.limits.home, clock)
    guard = Guard(arm, safety, clock)
    guard.start()
    return guard, arm, clock


def play(guard, arm, clock, target, steps):
    for _ in range(steps):
        clock.time += guard.safety.limits.dt
        guard.read()
        guard.command(target)


def bent(**fields):
    """Changes a feedback: ``position=lambda x, rng: ...``."""

    def bend(feedback, rng):
        return dataclasses.replace(feedback, **{name: change(getattr(feedback, name), rng) for name, change in fields.items()})

    return bend


def one(value):
    """Puts a value somewhere into an array."""

    def change(array, rng):
        out = array.copy()
        out[rng.integers(len(out))] = value
        return out

    return change


BENT = {
    "nan": [
        bent(position=one(np.nan)),
        bent(velocity=one(np.nan)),
        bent(position=one(np.inf)),
        bent(position=lambda x, rng: x[:-1]),
    ],
    "stale": [bent(time=lambda t, rng: t - 0.2), bent(time=lambda t, rng: float("nan"))],
    "range": [bent(position=lambda x, rng: x + 9.0), bent(position=one(-7.0))],
    "jump": [bent(position=lambda x, rng: x - np.array([0.35 * np.sign(x[0] or 1), 0, 0, 0, 0, 0]))],
    "temperature": [bent(temperature=one(61.0)), bent(temperature=one(np.nan))],
}
FULL = np.array([0, 0.95, 0, 0, 0, 0])  # a load
CUT = {"bus": ["read", "send", "read and send"]}


@pytest.mark.parametrize("kind", [*BENT, *CUT, "target"])
def test_a_hundred_faults_of_each_kind_end_in_hold_within_a_cycle(so101, kind):
    rng, cfg = np.random.default_rng(5), {"share": 0.5}
    for i in range(100):
        guard, arm, clock = guarded(so101, **cfg)
        limits = guard.safety.limits
        goal = rng.uniform(limits.lower, limits.upper)
        play(guard, arm, clock, goal, int(rng.integers(1, 16)))
        assert guard.fault is None
        before, count = (guard.safety.position.copy(), guard.safety.velocity.copy()), len(arm.told)
        if kind in BENT:
            bend = BENT[kind][i % len(BENT[kind])]
            arm.bend = lambda feedback, bend=bend: bend(feedback, rng)
        elif kind == "bus":
            arm.broken = CUT["bus"][i % 3]
            if "send" in arm.broken:  # what did not arrive left the drives at the target before: there the arm goes on from
                before = before[0], np.zeros(len(goal))
        target = np.full(len(goal), np.nan) if kind == "target" else goal
        play(guard, arm, clock, target, 1)
        assert guard.fault.kind == {"target": "nan"}.get(kind, kind)
        arm.bend, arm.broken = (lambda feedback: feedback), ""  # all is well again, and nothing resumes
        play(guard, arm, clock, goal, 12)
        path = arm.told[count:]
        assert violations_of(guard.safety, before, path) < 1e-6
        assert (np.abs(np.diff(np.array(path[-6:]), axis=0)) < 1e-12).all()  # it holds
        brake = before[1] ** 2 / (2 * limits.acceleration) + np.abs(before[1]) * limits.dt
        assert (np.abs(path[-1] - before[0]) <= brake + 1e-6).all()  # where it could stop


def violations_of(safety, before, path):
    commands = [dataclasses.make_dataclass("Sent", ["position", "velocity"])(q, None) for q in path]
    return max(violations(safety, before, commands).values())


def test_a_hundred_joints_that_stand_still_end_in_hold(so101):
    """Whichever of the arm's, wherever to: within the time that the layer gives it and a cycle, and it is pressed no more."""
    rng = np.random.default_rng(6)
    for i in range(100):
        guard, arm, clock = guarded(so101)
        limits, joint = guard.safety.limits, i % 5
        stuck, goal = arm.at[joint], limits.home.copy()
        goal[joint] += 1.0 if i % 2 else -1.0
        goal[joint] = np.clip(goal[joint], limits.lower[joint], limits.upper[joint])

        def still(feedback, joint=joint, stuck=stuck):
            position = feedback.position.copy()
            position[joint] = stuck
            return dataclasses.replace(feedback, position=position)

        arm.bend, behind, far = still, 0, rng.uniform(0.5, 1.0)
        goal[joint] = stuck + (goal[joint] - stuck) * far
        for _ in range(100):
            play(guard, arm, clock, goal, guard.fault is None)
            behind += guard.fault is None and abs(guard.safety.position[joint] - stuck) > guard.safety.cfg.behind
        if guard.fault is None:  # the table or a range kept it from getting that far behind
            assert behind == 0
            continue
        assert guard.fault.kind == "stall" and behind <= round(guard.safety.cfg.behind_s / limits.dt) + 2
        play(guard, arm, clock, goal, 60)
        assert arm.told[-1][joint] == pytest.approx(stuck, abs=1e-6)


def test_feedback_is_fuzzed(so101):
    fuzz_feedback(so101, 3000)


def fuzz_feedback(told, count):
    """Anything may be read: what is sent stays within the limits."""
    rng, done = np.random.default_rng(9), 0
    kinds = set()
    while done < count:
        guard, arm, clock = guarded(told)
        limits = guard.safety.limits
        goal, wildness = rng.uniform(limits.lower, limits.upper), 10.0 ** rng.uniform(-3, 3)

        def bend(feedback, wildness=wildness):
            n = len(feedback.position)
            values = feedback.position + rng.normal(0, wildness, n) * (rng.random() < 0.2)
            if rng.random() < 0.02:
                values = rng.choice([np.nan, np.inf, -np.inf, 1e300, 0.0, -0.0], n)
            late = rng.exponential(0.01) if rng.random() < 0.1 else 0.0
            load = rng.uniform(-1.2, 1.2, n) if rng.random() < 0.5 else None
            temperature = rng.normal(40, 8, n) if rng.random() < 0.5 else None
            return Feedback(feedback.time - late, values, rng.normal(0, 1, n), load, temperature)

        before, sent = (guard.safety.position.copy(), guard.safety.velocity.copy()), len(arm.told)
        arm.bend = bend
        steps = int(rng.integers(5, 60))
        play(guard, arm, clock, goal, steps)
        kinds.add(guard.fault.kind if guard.fault else "")
        done += steps
        assert violations_of(guard.safety, before, arm.told[sent:]) < 1e-6
    assert {"", "nan", "jump", "range"} <= kinds


def test_a_joint_that_does_not_follow_is_stalled_and_not_pressed(so101):
    guard, arm, clock = guarded(so101)
    stuck = arm.at.copy()
    arm.bend = lambda feedback: dataclasses.replace(feedback, position=stuck)
    goal = stuck + np.array([1.0, 0, 0, 0, 0, 0])
    play(guard, arm, clock, goal, 100)
    assert guard.fault.kind == "stall" and "shoulder_pan" in guard.fault.text
    held = arm.told[-1]
    assert held[0] == pytest.approx(stuck[0], abs=1e-9)  # what the drive is told is where the joint is: it presses no more
    np.testing.assert_allclose(held[1:], stuck[1:], atol=1e-9)
    assert violations_of(guard.safety, (stuck, np.zeros(6)), arm.told) < 1e-6


def test_a_blocked_drive_presses_no_more_and_the_others_brake(so101):
    """The shoulder, 0.1 rad behind its target, gives all it has; the pan turns at full speed; the gripper holds something."""
    guard, arm, clock = guarded(so101)
    start = arm.at.copy()

    def blocked(feedback):
        position = np.array([feedback.position[0], start[1], *feedback.position[2:5], start[5]])
        return dataclasses.replace(feedback, position=position, load=FULL + np.array([0, 0, 0, 0, 0, 1.0]))

    arm.bend, goal = blocked, start + np.array([0, -0.1, 0, 0, 0, 0.2])
    for k in range(60):
        goal[0] = start[0] + 0.03 * min(max(k - 30, 0), 25)
        play(guard, arm, clock, goal, 1)
        if guard.fault:
            break
    assert guard.fault.kind == "load" and "shoulder_lift" in guard.fault.text
    pan, sent = arm.at[0], len(arm.told)
    play(guard, arm, clock, goal, 40)
    held = arm.told[-1]
    assert held[1] == pytest.approx(start[1], abs=1e-9) and held[5] == pytest.approx(start[5] + 0.2, abs=1e-9)
    assert pan < held[0] < pan + 0.06  # it braked, and never came back
    assert (np.diff([told[0] for told in arm.told[sent:]]) > -1e-9).all()
    assert violations_of(guard.safety, (start, np.zeros(6)), arm.told) < 1e-6


def test_a_start_beyond_a_range_is_no_leap(so101):
    """An arm at rest a little beyond its range is told to be where it is, and comes back at its own speed, never further out."""
    safety = setup.safety_of(so101, fence=FenceCfg(table=-3.0, box=((-3, 3), (-3, 3), (-3, 3))))
    limits, at = safety.limits, safety.limits.home.copy()
    at[4] = limits.upper[4] + 0.08
    safety.begin(Feedback(0.0, at, np.zeros(6)), 0.0, anywhere=True)
    np.testing.assert_array_equal(safety.step(at + 1.0).position[4], at[4])
    path = np.array([at, *(safety.step(limits.home).position for _ in range(200))])
    outside = int(np.argmax(path[:, 4] <= limits.upper[4]))
    steps = np.diff(path[: outside + 1, 4])
    assert outside > 3 and steps.max() < 0 and -steps.min() <= limits.speed[4] * limits.dt + 1e-9
    np.testing.assert_allclose(path[-1], limits.home, atol=1e-6)
    assert max(safety.step(at).position[4] for _ in range(100)) <= limits.upper[4]


def test_the_gripper_may_be_stopped_by_what_it_holds(so101):
    guard, arm, clock = guarded(so101)
    stuck = arm.at.copy()
    arm.bend = lambda feedback: dataclasses.replace(feedback, position=stuck, load=np.array([0, 0, 0, 0, 0, 1.0]))
    play(guard, arm, clock, stuck + np.array([0, 0, 0, 0, 0, 0.5]), 100)
    assert guard.fault is None


def test_a_blocked_drive_holds_and_a_fast_one_goes_on(so101):
    for way, kind in ((0.0, "load"), (-0.5, None)):
        guard, arm, clock = guarded(so101)
        arm.bend = lambda feedback: dataclasses.replace(feedback, load=FULL)
        start = arm.at.copy()
        for i in range(60):  # the shoulder rises, slowly, or stays
            play(guard, arm, clock, start + np.array([0, way * i / 60, 0, 0, 0, 0]), 1)
        assert (guard.fault and guard.fault.kind) == kind


def test_the_first_fault_stays(so101):
    guard, arm, clock = guarded(so101)
    guard.hold(Fault("stop", "first"))
    arm.broken = "read"
    play(guard, arm, clock, arm.at, 3)
    assert guard.fault == Fault("stop", "first")


@pytest.mark.parametrize("joint", range(5))
def test_a_start_far_from_home_is_refused(so101, joint):
    safety = setup.safety_of(so101)
    at = safety.limits.home.copy()
    at[joint] += 0.4 if at[joint] + 0.4 < safety.limits.upper[joint] else -0.4
    name = safety.limits.names[joint]
    with pytest.raises(UserError, match=rf"far from home: {name} by 0\.40 .*: move it home slowly with --go-home"):
        safety.begin(Feedback(0.0, at, np.zeros(6)), 0.0)
    safety.begin(Feedback(0.0, at, np.zeros(6)), 0.0, anywhere=True)


def test_a_start_at_fault_is_refused(so101):
    safety = setup.safety_of(so101)
    with pytest.raises(UserError, match="the arm cannot start: the arm's feedback is 500 ms old"):
        safety.begin(Feedback(0.0, safety.limits.home, np.zeros(6)), 0.5)


@pytest.mark.parametrize(
    ("field", "value"), [("speed", 1e5), ("speed", 0.0), ("upper", -3.0), ("lower", -1e5), ("home", 2.5), ("home", float("nan"))]
)
def test_a_file_whose_limits_are_no_arms_is_refused(so101, field, value):
    """The layer's limits are the file's: a file that says nonsense must not be what switches it off."""
    joints = {**so101["joints"], field: [value, *so101["joints"][field][1:]]}
    with pytest.raises((UserError, ValueError), match="are implausible|the description's"):
        setup.check({**so101, "joints": joints})


@pytest.mark.parametrize("dt", [0.0, 5.0])
def test_a_file_of_an_impossible_rate_is_refused(so101, dt):
    with pytest.raises((UserError, ValueError), match="are implausible|the description's"):
        setup.check({**so101, "control_dt": dt})


@pytest.mark.parametrize("robot", ROBOTS)
def test_all_bundled_robots_limits_are_an_arms(robot):
    setup.check(arms.metadata(robot))


def test_files_of_older_versions_are_refused(so101):
    old = {name: value for name, value in so101.items() if name != "body"}
    with pytest.raises(UserError, match="lacks body: export the policy again"):
        setup.check(old)
