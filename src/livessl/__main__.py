"""`python -m livessl`: the command line."""

from livessl.cli.main import main

if __name__ == "__main__":
    raise SystemExit(main())
