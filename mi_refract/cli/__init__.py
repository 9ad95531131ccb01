"""The command `mi-refract`: one module a command."""


def main(arguments: list[str] | None = None) -> int:
    """Run the command; the exit code."""
    from .app import main

    return main(arguments)
