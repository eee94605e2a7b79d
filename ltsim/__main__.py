"""The command line as ``python -m ltsim``."""

from ltsim.cli.main import main

if __name__ == "__main__":
    main()
