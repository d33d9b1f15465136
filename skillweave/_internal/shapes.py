"""Annotations that say the shape of an array: ``Float[Tensor, "P T B"]`` is a tensor of floats.

They are ``Annotated``, so they cost nothing and need no package. While the tests run,
``tests/conftest.py`` puts those of jaxtyping in their place, and every call is checked.

In a shape, each letter is an axis and means the same size in a whole signature; ``*batch`` is
any number of axes, ``#`` before a name lets an axis be 1 instead.
"""

from typing import Annotated as Bool, Annotated as Float, Annotated as Int

__all__ = ["Bool", "Float", "Int"]
