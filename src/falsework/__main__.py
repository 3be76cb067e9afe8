"""Run the command line, as the program `falsework` or as `python -m falsework`."""

import signal
import sys


def main() -> int:
    """Run the command line and return its exit code; an interrupt while its modules are imported is none of theirs."""
    try:
        from falsework.cli.main import main as run

        code = run()
    except KeyboardInterrupt:
        sys.stderr.write("falsework: interrupted\n")
        code = 130
    if sys.platform != "win32":
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # nothing is left to interrupt but the end of the interpreter
    return code


if __name__ == "__main__":
    sys.exit(main())
