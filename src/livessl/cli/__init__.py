"""The command line: `main` runs a command, and each command is a module of its name.

Commands read arguments, call the other packages and print. They compute nothing themselves, and nothing imports them.
"""
