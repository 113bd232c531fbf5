"""A page of results says of which plan, models and cars it is, and is marked stale when they are others by now.

``python -m benchmarks.paper.stale benchmarks/results/results.md benchmarks/results/results_race.md`` marks pages, or takes
the mark off; a test of the documentation asks for it.
"""

from __future__ import annotations

import argparse
import re
import sys
from pathlib import Path

from benchmarks.paper.plan import Plan, load_plan
from dynssm_ros.files import content_key, replacing
from dynssm_ros.vehicle import load_vehicle

NOTE = (
    "> **Stale.** The plan of the measurements, a model file or a vehicle has changed since this page was made. "
    "`make paper` measures anew."
)


def fingerprint(plan: Plan) -> str:
    """SHA-256 of all settings that the results follow from: the plan, its models and its vehicles."""
    said = {"given", "remark", "wanted"}
    studies = {name: study.model_dump(mode="json", exclude=said) for name, study in plan.studies.items()}
    content = {
        "plan": plan.model_dump(mode="json", exclude={"studies", "models", "cars"}),
        "studies": studies,
        "cars": {name: car.model_dump(mode="json", exclude={"vehicle"}) for name, car in plan.cars.items()},
        "models": {
            name: model.model_dump(mode="json", exclude={"vehicle"}) | plan.configured(name).model_dump(mode="json")
            for name, model in plan.models.items()
        },
        "vehicles": sorted(load_vehicle(name).model_dump_json() for name in plan.vehicles),
    }
    return content_key(content)


def signed(text: str, plan: Plan) -> str:
    """A page with the fingerprint of its plan at its end."""
    return f"{text.rstrip()}\n\n<!-- settings: {fingerprint(plan)} -->\n"


def marked(text: str, plan: Plan) -> str:
    """The page with the note below its title if it is not of ``plan``, without it if it is."""
    plain = text.replace(f"{NOTE}\n\n", "")
    found = re.search(r"<!-- settings: ([0-9a-f]{64}) -->", plain)
    if found and found.group(1) == fingerprint(plan):
        return plain
    title, _, rest = plain.partition("\n\n")
    return f"{title}\n\n{NOTE}\n\n{rest}"


def main(arguments: list[str]) -> None:
    """Marks pages in place."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pages", nargs="+", type=Path, metavar="PAGE")
    plan = load_plan()
    for page in parser.parse_args(arguments).pages:
        text = marked(page.read_text(encoding="utf-8"), plan)
        with replacing(page) as aside:
            aside.write_text(text, encoding="utf-8")
        print(f"{page}: {'stale' if NOTE in text else 'of the present plan'}")


if __name__ == "__main__":
    main(sys.argv[1:])
