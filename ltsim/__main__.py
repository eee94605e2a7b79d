"""Entry point of the command line, also as ``python -m ltsim``."""

import signal


def main() -> None:
    """Command line with the arguments of the process; Ctrl-C while its modules are imported ends it without output."""
    is_interruptible = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if is_interruptible:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from ltsim.cli.main import main as run_command_line

    if is_interruptible:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    run_command_line()


if __name__ == "__main__":
    main()
