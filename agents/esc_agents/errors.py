"""The one error that means: the user can mend this."""


class UserError(Exception):
    """One line for the user: what was expected, what came, what to do. Exit code 2."""
