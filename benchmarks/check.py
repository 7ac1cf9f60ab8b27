"""Does a task meet the contract? `deconf check --task slippery_cartpole`, or path/file.py:Class

Runs `check_task`, and if it passes every check of the contract for tasks, a line for each; exit code 1 if any fails.
"""

import sys

from deconfounded import envs
from deconfounded.benchmarks.console import Parser
from deconfounded.envs.contract.check import check_task, sentence
from deconfounded.envs.contract.core import CONTRACT
from deconfounded.envs.contract.probe import Skipped


def main() -> None:
    parser = Parser(__doc__, "--task")
    task = envs.get(parser.parse_args().task)
    faults: dict[str, str] = {}  # the first check that reports each
    for name, check in {"check_task": check_task, **CONTRACT}.items():
        try:
            check(task)
        except Skipped as why:
            print(f"skip {name}: {why}", flush=True)
        except (Exception, SystemExit) as error:
            fault = sentence(error)
            same = next((f"the same as {first}" for text, first in faults.items() if text in fault), "")
            faults.setdefault(fault, name)
            print(f"FAIL {name}: {same or fault}", flush=True)
            if check is check_task:  # what it says would be said in many other ways
                print(f"skip the other {len(CONTRACT)} checks until that is mended", flush=True)
                break
        else:
            print(f"ok   {name}", flush=True)
    sys.exit(bool(faults))
