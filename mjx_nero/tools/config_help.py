"""The end of a help text: every config field as a dotted flag."""

import argparse
import textwrap
from collections.abc import Mapping
from typing import Any

from mjx_nero import config, control
from mjx_nero.learn import learner
from mjx_nero.tasks import registry


def of_environment(args: argparse.Namespace) -> str:
    """Lists the fields of the environment that a command's flags choose."""
    return listed({"env": registry.env_cfg(args.env, args.preset, args.robot)})


def listed(cfgs: Mapping[str, Any]) -> str:
    """Lists the dotted flags of the configs, each with its default and description.

    Args:
        cfgs: configs by prefix, the environment's as ``env``.
    """
    lines = ["any config field, with its default:"]
    for prefix, cfg in cfgs.items():
        about = config.describe(cfg) | (_lent(cfg) if prefix == "env" else {})
        for name, value in config.flatten(cfg).items():
            lines.append(f"  --{prefix}.{name} {value!r}")
            lines += textwrap.wrap(about[name], 100, initial_indent=" " * 8, subsequent_indent=" " * 8)
    return "\n".join(lines)


def _lent(cfg: Any) -> dict[str, str]:
    """Returns descriptions of the fields of controllers and learner that an environment's config sets, by dotted name."""
    owners = {f"controllers.{name}": control.CONTROLLERS.find(name)[1] for name in cfg.controllers}
    owners["training"] = learner.cfg_for(cfg.learner, "default", {})
    return {f"{at}.{name}": text for at, owner in owners.items() for name, text in config.describe(owner).items()}
