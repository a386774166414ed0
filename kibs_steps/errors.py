"""The one base of all errors that a user can mend: each says what is wrong, where, and what to do."""


class KibsError(Exception):
    """An input or a result that cannot be used, told in a sentence a user can act on."""
