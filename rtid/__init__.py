"""rtid: learns valve flow maps and the bulk modulus of a hydraulic machine from CAN frames.

import rtid
study = rtid.Study("machine.toml", "run.blf")
print(study.diagnosis().verdict, study.map["pa"])
"""

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

_HOMES = {  # a name is imported when it is asked for: `rtid --help` waits for none of them
    "load": "rtid.project",
    "Project": "rtid.project",
    "Machine": "rtid.model:Machine",
    "Trace": "rtid.trace.reading",
    "Estimator": "rtid.estimator.estimator",
    "Map": "rtid.estimator.flowmap:FlowMap",
    "Comparison": "rtid.study.compared:TraceComparison",
    "Diagnosis": "rtid.diagnose.report",
    "Study": "rtid.study.study",
    "fit": "rtid.tell.arrays",
    "define": "rtid.effects",
}
__all__ = ["__version__", *_HOMES]  # noqa: PLE0604 - keys are names


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"rtid has no {name!r}; it has {', '.join(_HOMES)}")
    module, _, inner = _HOMES[name].partition(":")
    return getattr(import_module(module), inner or name)


def __dir__() -> list[str]:
    return sorted(__all__)
