"""The one base of all errors that a user can mend: each says what is wrong, where, and what to do."""

AGAIN = "run the same command again"  # what every message says whose cause is not the block it befell


class KibsError(Exception):
    """An input or a result that cannot be used, told in a sentence a user can act on."""
