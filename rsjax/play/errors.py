"""What a page asked for and cannot have."""


class Refused(Exception):
    """A message of a page cannot be done; the session goes on.

    Attributes:
        code: a short word for the page, one of those in docs/play_protocol.md.
        message: one plain line for the person.
    """

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code, self.message = code, message
