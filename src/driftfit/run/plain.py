"""Results as plain data, and the classes that users get in their place.

A verb such as `smooth` acts on a result and lives above it, so a result cannot have it as a method without a circle.
Below the verbs results are plain data; the facade (`driftfit.results`, `driftfit.streams`) declares a class of each
kind that has the verbs as methods too, with ``public=True``, and from then on that is what the plain one makes.
"""

from __future__ import annotations

from typing import Any, ClassVar, Self


class Plain:
    """A result or a stream as data: ``Kind(...)`` makes an instance of its public class."""

    _public: ClassVar[dict[type, type]] = {}

    def __init_subclass__(cls, public: bool = False, **settings: Any) -> None:
        super().__init_subclass__(**settings)
        if public:
            plain = next(one for one in cls.__mro__[1:] if one.__name__ == cls.__name__)
            Plain._public[plain] = cls

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        return object.__new__(Plain._public.get(cls, cls))

    @classmethod
    def public(cls) -> type[Self]:
        """The class that users get."""
        return Plain._public.get(cls, cls)
