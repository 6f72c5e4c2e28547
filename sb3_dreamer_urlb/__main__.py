"""The command line: ``sb3-dreamer-urlb demo``, or ``python -m sb3_dreamer_urlb demo``."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path


def main(argv: Sequence[str] | None = None) -> int:
    """Parse the command line and run the command.

    :param argv: arguments, those of the process if None
    :return: exit status
    """
    parser = argparse.ArgumentParser(prog="sb3-dreamer-urlb", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    demo = commands.add_parser("demo", help="pre-train and fine-tune a small agent on walker pixels, and show the result")
    demo.add_argument("--out", type=Path, help="folder for everything that is written (default: demo_output)")
    demo.add_argument("--task", help="fine-tuning task, for example walker-walk")
    demo.add_argument("--seed", type=int)
    demo.add_argument("--pretrain-frames", type=int)
    demo.add_argument("--finetune-frames", type=int)
    demo.add_argument("--episodes", type=int, help="evaluation episodes")
    demo.add_argument("--preset", help="of the model (default: small)")
    options = {name: value for name, value in vars(parser.parse_args(argv)).items() if value is not None}
    options.pop("command")

    # Torch's threads wait asleep: spinning costs a factor of ten where another program uses the other core, and saves a
    # tenth where none does. The variable is read when torch is imported.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    # Heavy imports only now, so that --help answers at once.
    from sb3_dreamer_urlb.demo import DemoConfig, run_demo

    try:
        run_demo(DemoConfig(**options))
    except (ValueError, ImportError) as error:
        print(f"sb3-dreamer-urlb: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
