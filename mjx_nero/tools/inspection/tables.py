"""The report as tables."""

from collections.abc import Sequence

from mjx_nero.config.bounds import Range
from mjx_nero.runs.console import Table
from mjx_nero.tools.inspection.report import Report, Task
from mjx_nero.tools.motion import Move


def tables(report: Report) -> list[Table]:
    """Makes the tables of a report."""
    joints = _table(f"joints of {report.robot}", "joint", "range", "home", "stiffness", "damping", "effort", "speed", "")
    for j in report.joints:
        gains = (j.home, j.stiffness, j.damping, j.effort, j.speed)
        note = f"{j.kind}, follows {j.follows}" if j.follows and j.home is None else j.kind
        joints.add(j.name, _range(j.range), *map(_number, gains), f"{note}, {j.group}" if j.group.endswith("gripper") else note)
    joints.caption = "rad, N m/rad, N m s/rad, N m, rad/s; slides: m, N/m, N s/m, N, m/s"
    out = [joints]
    if report.open:
        names = [j.name for j in report.joints if j.group == "gripper"]
        gripper = _table("gripper", "", *names, "gap [mm]")
        ends = zip(("open", "closed"), (report.open, report.close), report.gaps or (None, None), strict=True)
        for name, values, gap in ends:
            gripper.add(name, *map(_number, values), "unknown" if gap is None else f"{1e3 * gap:.1f}")
        if report.room and report.gaps and report.gaps[0] > report.room + 2e-3:
            gripper.caption = f"it swings open: only {1e3 * report.room:.0f} mm fit between the pads"
        out.append(gripper)
    drives = _table("actuators: position drives", "actuator", "joint", "target", "force")
    for a in report.actuators:
        drives.add(a.name, a.joint, _range(a.target), _range(a.force))
    sites = _table("sites at home [m]", "site", "x", "y", "z")
    for name, position in report.sites.items():
        sites.add(name, *(_fixed(x, 3) for x in position))
    regions = _table("regions in the robot's frame, before its base is turned [m]", "region", "x", "y", "z")
    for name, box in report.regions.items():
        regions.add(name, *map(_range, box))
    masses = _table("masses [kg]", "body", "mass")
    for name, mass in report.masses.items():
        masses.add(name, f"{mass:.4g}")
    masses.add("together", f"{sum(report.masses.values()):.4g}")
    masses.caption = f"gravity is {'' if report.gravity_compensation else 'not '}compensated"
    return [
        *out,
        drives,
        sites,
        *([regions] if report.regions else []),
        masses,
        *_contact_tables(report),
        *(_task_tables(report.task) if report.task else []),
    ]


def move_table(moved: Sequence[Move]) -> Table:
    """Makes the table of movements, one row each."""
    title = "movements at the drives' speed limits, without contacts"
    view = _table(title, "joint", "from", "to", "error", "time [s]", "fastest", "saturated [%]")
    for m in moved:
        there = "not reached" if m.time is None else f"{m.time:.2f}"
        ends, error = (_fixed(m.start, 3), _fixed(m.target, 3)), _fixed(abs(m.end - m.target), 4)
        view.add(m.joint, *ends, error, there, f"{m.fastest:.2f}", f"{100 * m.saturation:.0f}")
    view.caption = "time: until within 1% of the joint's range of the target; rad, rad/s; slides: m, m/s"
    return view


def _contact_tables(report: Report) -> list[Table]:
    pairs = _table("geoms that can touch", "geom", "geom", "shapes", "contacts", "condim", "rows")
    for p in report.pairs:
        pairs.add(p.first, p.second, p.shapes, str(p.contacts), str(p.condim), str(p.rows))
    budget = _table("maximum of one environment", "", "needed", "buffer (MJX-Warp)")
    shared = f"{report.contacts_per_env} on average, shared by all environments"
    budget.add("contacts", str(report.contacts), shared)
    budget.add("constraint rows", str(sum(report.rows.values())), str(report.constraints_per_env))
    for name, rows in report.rows.items():
        budget.add(f"  {name}", str(rows), "")
    return [pairs, budget]


def _task_tables(task: Task) -> list[Table]:
    head = Table(f"task of {task.env}, preset {task.preset}", ("", ""), left=("",))
    head.add("episode", f"{task.episode_s:g} s in steps of {task.control_dt:.4g} s")
    head.add(f"actions ({task.action_size})", task.action)
    head.add("command", task.command)
    for what, terms in (("object", task.objects), ("termination", task.terminations), ("event", task.events)):
        for name, text in terms.items():
            head.add(f"{what} {name}", text)
    rewards = _table("rewards, per second", "term", "weight")
    for name, weight in task.rewards.items():
        rewards.add(name, f"{weight:g}")
    out = [head, rewards]
    for group, sizes in task.observations.items():
        view = _table(f"observations: {group}", "term", "size")
        for name, size in sizes.items():
            view.add(name, str(size))
        view.add("together", str(sum(sizes.values())))
        out.append(view)
    return out


def _table(title: str, *columns: str, caption: str = "") -> Table:
    """Makes a table with names aligned left and everything else aligned right."""
    return Table(title, columns, left=("joint", "geom", "shapes"), caption=caption)


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.5g}"


def _fixed(value: float, digits: int) -> str:
    return f"{round(value, digits) + 0.0:.{digits}f}"  # + 0.0: no "-0.000"


def _range(pair: Range | None) -> str:
    return "unlimited" if pair is None else f"{pair[0]:.5g} .. {pair[1]:.5g}"
