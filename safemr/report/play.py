"""``safemr play``: an episode of a record's policy as a film, with phi and the filter beside it.

safemr play results/runs/Pillars-0.15-Goal/SafeMR/seed0-* --video out.gif
safemr play .../PPO-L/seed0-* --certificate phi_h --filter --video out.mp4
"""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Sequence
from pathlib import Path

from safemr.certificates.bound import BoundCertificate
from safemr.conventions import unseen_seed
from safemr.environments import PACKAGE
from safemr.errors import UserError
from safemr.experiment.filter_entries import HANDCRAFTED
from safemr.experiment.loaded import load
from safemr.measure.filters import episode, handcrafted
from safemr.report.figures.episodes import check_video, film

STEPS = 400  # control steps drawn


def main(arguments: Sequence[str] | None = None) -> int:
    """``safemr play RECORD --video FILE``: one line about the episode, and the film."""
    parser = argparse.ArgumentParser(
        prog="safemr play", description="Draw an episode of a record's policy as a film."
    )
    parser.add_argument("record", type=Path, metavar="RECORD", help="its folder")
    parser.add_argument("--video", type=Path, required=True, help="to write: .gif or .mp4")
    parser.add_argument(
        "--certificate",
        default="",
        help=f"whose phi: {', '.join(HANDCRAFTED)} or a record (default: the record's own)",
    )
    parser.add_argument("--filter", action="store_true", help="fly the filter's actions")
    parser.add_argument("--layout", type=int, help="its seed (default: one that no run has seen)")
    parser.add_argument("--steps", type=int, default=STEPS, help="control steps, at most")
    parser.add_argument("--stride", type=int, default=4, help="steps a frame")
    options = parser.parse_args(arguments)
    if options.steps < 1 or options.stride < 1 or (options.layout or 0) < 0:
        raise UserError("--steps and --stride must be 1 or more, and --layout 0 or more")
    check_video(options.video)
    record = load(options.record)
    envs = record.make_envs(1)
    d_min, drawn = float(envs.d_min), hasattr(envs, "scene")
    rate = float(envs.metadata.get("render_fps", 50))  # steps a second
    envs.close()
    if options.certificate in HANDCRAFTED:
        certificate = BoundCertificate(handcrafted(options.certificate), d_min)
    elif options.certificate:
        plain = load(options.certificate).record.certificate()
        certificate = BoundCertificate(plain, d_min)
    else:
        certificate = record.certificate
    seed = unseen_seed(record.record.seed) if options.layout is None else options.layout
    data = episode(
        record.policy, record.record.task, certificate.certificate,
        seed=seed, steps=options.steps, act=options.filter,
    )  # fmt: skip
    # Drawings of scenes belong to the environments, of which this package imports nothing.
    draw_scene = importlib.import_module(f"{PACKAGE}.drawing").draw_scene if drawn else None
    behind = f" behind the filter of {certificate.name}" if options.filter else ""
    title = f"{record.name} on {record.record.task['name']}{behind}"
    film(
        data, certificate, options.video,
        title=title, acts=options.filter, draw_scene=draw_scene, stride=options.stride,
        step_s=1 / rate,
    )  # fmt: skip
    print(
        f"{options.video}: {title}, layout {seed}, {len(data['phi'])} steps: return "
        f"{data['reward'].sum():.2f}, violating steps {int(data['violating'].sum())}, the filter "
        f"{'acted' if options.filter else 'would have acted'} in {data['intervened'].mean():.1%}"
    )
    return 0
