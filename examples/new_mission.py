"""A mission for the lander, typed and flown at once: the skills are known, nothing is trained.

    python examples/new_mission.py "right then left then hover for 100 steps then land"

The words are left, right, hover and land: what the four skills of ``lander-missions`` are for.
Their calls are logged once (in calls.safetensors); then each new mission takes a second to plan. It
needs box2d: ``pip install 'skillweave[box2d]'``.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import skillweave as sw
from skillweave.planning import CallLog


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("mission", help='such as "left then land"')
    parser.add_argument("--steps", type=int, default=20_000, help="to log, if there is no log yet")
    parser.add_argument("--log", default="calls.safetensors", help="the log's file")
    parser.add_argument("--episodes", type=int, default=20, help="to fly for the score")
    parser.add_argument("--film", help="a .gif or .mp4 to write")
    given = parser.parse_args()

    run = sw.Hierarchy.pretrained("lander-missions")
    if not Path(given.log).exists():
        run.log_calls(given.steps).save(given.log)
    log = CallLog.load(given.log)
    print(log)

    try:
        planned = run.plan(given.mission, log)
    except sw.SkillweaveError as error:  # it points at the word
        raise SystemExit(str(error)) from None
    print(planned.evaluate(given.episodes, quiet=True))
    if given.film:
        planned.render(given.film)


if __name__ == "__main__":
    main()
