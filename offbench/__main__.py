"""`python -m offbench` is `offbench`."""

from offbench.cli.main import main

if __name__ == "__main__":
    main()
