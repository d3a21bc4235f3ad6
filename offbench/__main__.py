"""`python -m offbench` is `offbench`."""

from offbench.cli import main

if __name__ == "__main__":
    main()
