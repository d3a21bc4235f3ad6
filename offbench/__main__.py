"""Run the command line as `python -m offbench`."""

import sys


def main() -> None:
    """Run one command; see offbench.cli.main."""
    try:
        from offbench.cli.main import main as run
    except KeyboardInterrupt:  # Ctrl-C during the import
        sys.exit(130)
    run()


if __name__ == "__main__":
    main()
