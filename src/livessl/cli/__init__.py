"""The command line: `main` reads arguments, and each command has a file of its own name.

Commands parse, call and print; they hold no algorithm, and nothing imports them.
"""
