"""The command line of ``demos``."""

import contextlib
import functools
import pathlib
import time
from collections.abc import Iterator, Sequence

from mjx_nero.data import Episode, writer
from mjx_nero.errors import UserError
from mjx_nero.runs import console
from mjx_nero.tools import cli, config_help
from mjx_nero.tools.demos.cfg import DemosCfg

_LOG = "write a log of 'deploy --log' on a real arm as an episode, instead of simulated ones; give successful runs; repeatable"


def main(argv: Sequence[str]) -> None:
    """The command line.

    Raises:
        UserError: a name is unknown, the folder holds something else, a package is missing, the disk is full, or no episode
            succeeds.
    """
    parser = cli.Parser(
        "demos",
        "Writes episodes of an expert or a policy as a data set, in LeRobot's format by default, or inspects or replays one.",
    )
    parser.add_environment()
    parser.add_seed(0)
    parser.add_argument("--out", type=cli.path(), metavar="DIR", help="folder to write to, or data set to continue")
    parser.add_fields(DemosCfg)
    parser.add_argument("--log", type=cli.path(".csv"), action="append", metavar="FILE", help=_LOG)
    parser.add_argument("--inspect", type=cli.path(), metavar="DIR", help="show the contents of a data set")
    parser.add_argument(
        "--sheet", type=cli.output(".png"), metavar="FILE", help="with --inspect: draw pictures of the first episodes"
    )
    parser.add_argument("--replay", type=cli.path(), metavar="DIR", help="replay an episode of a data set in simulation")
    parser.add_argument("--episode", type=cli.number(int), default=0, help="with --replay: index of the episode, from 0")
    parser.add_argument("--video", type=cli.output(".mp4"), help="with --replay: write a video of the episode")
    args, dotted = parser.parse(argv, ("env",), config_help.of_environment)
    asked = [name for name in ("out", "inspect", "replay") if getattr(args, name)]
    if len(asked) != 1:
        raise UserError("demos takes exactly one of --out DIR (write), --inspect DIR (show) and --replay DIR (play again)")
    if args.video and not args.replay:
        raise UserError("--video shows a replayed episode: pass --replay, too")
    if args.log and not args.out:
        raise UserError("--log needs --out DIR, the folder to write to")
    if args.sheet and not args.inspect:
        raise UserError("--sheet shows pictures of a data set: pass --inspect, too")
    if args.inspect:
        from mjx_nero.tools.demos import inspection

        return inspection.show(args.inspect, args.sheet)
    cli.setup_jax()
    if args.replay:
        from mjx_nero.tools.demos import replay

        return replay.show(args.replay, args.episode, args.video)
    cfg = DemosCfg(args.env, args.preset, args.robot, seed=args.seed, env_fields=dotted["env"], **cli.fields(args, DemosCfg))
    if args.log:
        from mjx_nero.tools.demos import logs

        return logs.write(cfg, args.log, args.out)
    write(cfg, args.out)


def write(cfg: DemosCfg, out: pathlib.Path) -> None:
    """Plays episodes and writes them piece by piece, until the data set has as many as requested.

    Raises:
        UserError: see ``main``.
    """
    from mjx_nero.learn import waiting
    from mjx_nero.tools.demos import making

    schema, player = making.prepare(cfg)
    screen, begun, busy = console.screen(stderr=True), time.perf_counter(), time.process_time()
    with contextlib.closing(player), writer(out, schema, cfg.form) as form:
        before, tries, none = len(form.lengths), 0, 0
        first = int(form.numbers[-1]) + 1 if before else 0
        take = functools.partial(_take, player(first, cfg.seed), player.size, cfg.all)
        batch = waiting.begun(take, cfg.episodes - before)
        while len(form.lengths) < cfg.episodes:
            kept, played = batch()
            batch = waiting.begun(take, cfg.episodes - len(form.lengths) - len(kept))  # plays while the last ones are written
            tries, none = tries + played, 0 if kept else none + played
            if kept:
                form.put(kept)
                console.line(screen, f"{out}: {len(form.lengths)} of {cfg.episodes} episodes; {len(kept)}/{played} kept")
            elif none >= making.HOPELESS:
                raise UserError(f"none of {none} episodes succeeded: try another --agent, or keep them with --all")
        frames, new = int(form.lengths.sum()), len(form.lengths) - before
    took = f"{time.perf_counter() - begun:.1f} s ({time.process_time() - busy:.1f} s of core time), compilation included"
    print(f"{out}: {len(form.lengths)} episodes, {frames} steps; {new} new, from {tries} played in {took}")


def _take(episodes: Iterator[Episode], most: int, all: bool, wanted: int) -> tuple[list[Episode], int]:
    """Plays until ``wanted`` episodes are to be kept, but at most ``most``. Returns those to keep, and how many were played."""
    kept, played = list[Episode](), 0
    while len(kept) < wanted and played < most:
        episode, played = next(episodes), played + 1
        if episode.success or all:
            kept.append(episode)
    return kept, played
