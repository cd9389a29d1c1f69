"""JSON Schemas of the program's answers, written to docs/schema: ``python3 tools/json_schemas.py``."""

import json
import sys
from pathlib import Path

import msgspec

from estimator.answers.answer import Answer
from estimator.answers.binding import BindingAnswer
from estimator.answers.diagnosis import DiagnosisAnswer
from estimator.answers.draws import DrawsAnswer
from estimator.answers.fleet import FleetAnswer
from estimator.answers.inspection import InspectionAnswer
from estimator.answers.published import PublishedAnswer
from estimator.answers.run import RunAnswer
from estimator.answers.simulation import SimulationAnswer
from estimator.answers.status import NotRunningAnswer, StatusAnswer
from estimator.answers.vehicle import VehicleAnswer
from estimator.answers.watch import WatchAnswer

FOLDER = Path(__file__).parents[1] / "docs" / "schema"
ANSWERS: dict[str, type[Answer]] = {
    "binding": BindingAnswer,
    "diagnosis": DiagnosisAnswer,
    "draws": DrawsAnswer,
    "fleet": FleetAnswer,
    "inspection": InspectionAnswer,
    "not_running": NotRunningAnswer,
    "published": PublishedAnswer,
    "run": RunAnswer,
    "simulation": SimulationAnswer,
    "status": StatusAnswer,
    "vehicle": VehicleAnswer,
    "watch": WatchAnswer,
}


def schemas() -> dict[Path, str]:
    """The text of each file; `decode` refuses an answer without ``schema``, so the key is required."""
    texts: dict[Path, str] = {}
    for name, kind in ANSWERS.items():
        schema = msgspec.json.schema(kind)
        answer = schema["$defs"][kind.__name__]
        answer["required"] = ["schema", *answer["required"]]
        del answer["properties"]["schema"]["default"]
        texts[FOLDER / f"{name}.json"] = json.dumps(schema, indent=1) + "\n"
    return texts


def main() -> int:
    """Write the files."""
    for path, text in schemas().items():
        path.write_text(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
