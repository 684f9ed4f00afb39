"""Results as plain data, and the public classes that replace them.

A verb such as `smooth` takes a result and is in a higher layer, so a result cannot have it as a method without a
circular import. Below the verbs, results are plain data. The facade (`driftfit.results`, `driftfit.streams`) declares a
class of each kind that also has the verbs as methods, with ``public=True``; from then on the plain class makes
instances of that class.
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
