"""Entry point of the command `viapoint`, which imports packages of the extra `training` only if they are installed."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace

from viapoint.training.cli import doctor


def main() -> None:
    """Run the command; if packages are missing, print what to install and exit with code 2."""
    try:
        from viapoint.training.cli.main import main as run
    except ImportError as error:
        if sys.argv[1:2] == ["doctor"]:
            doctor.run(SimpleNamespace(out=Path("runs")))
        if "--debug" in sys.argv:
            raise
        print(f"viapoint: {doctor.explain_import_error(error)}", file=sys.stderr)
        raise SystemExit(2) from None
    run()


if __name__ == "__main__":
    main()
