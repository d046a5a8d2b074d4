"""Arrays, and tuples of them, as compiled code hands them to the functions that it calls: without copies and counts.

numba passes a tuple by its parts. A hundred arrays are a thousand numbers, which every call would copy, and which every
function compiled for such a call would take apart and put together again. A borrowed tuple stands in memory, and
functions are given its address.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import Any, TypeVar, cast

from numba import types
from numba.core import cgutils
from numba.core.datamodel import models
from numba.core.datamodel.registry import register_default
from numba.core.typing.templates import AttributeTemplate
from numba.extending import infer_getattr, intrinsic, lower_getattr_generic
from numba.np.arrayobj import make_array

Lent = TypeVar("Lent")
# numba has no types for what its extensions are made of.
_Type: Any = types.Type
_Template: Any = AttributeTemplate
_lower_getattr: Any = lower_getattr_generic


class Borrowed(_Type):  # type: ignore[misc]
    """Type of the address of a named tuple `of` some type; its attributes are read as those of the tuple."""

    def __init__(self, of: Any) -> None:
        self.of = of
        # The tuple's own name lists all types in it, and would be part of the name of every function.
        digest = hashlib.sha256(str(of).encode()).hexdigest()[:12]
        super().__init__(name=f"{of.instance_class.__name__}_{digest}")

    @property
    def key(self) -> Any:
        return self.of

    @property
    def instance_class(self) -> type:
        """Class of the tuple."""
        return cast(type, self.of.instance_class)


@register_default(Borrowed)
class _BorrowedModel(models.PrimitiveModel):
    def __init__(self, manager: Any, borrowed: Borrowed) -> None:
        address = manager.lookup(borrowed.of).get_value_type().as_pointer()
        cast(Any, super()).__init__(manager, borrowed, address)


def _lent(context: Any, builder: Any, kind: Any, item: Any) -> Any:
    """The value without reference counts: of an array, or of all arrays in a tuple."""
    if isinstance(kind, types.Array):
        view = cast(Any, make_array)(kind)(context, builder, item)
        null: Any = cgutils.get_null_value
        view.meminfo, view.parent = null(view.meminfo.type), null(view.parent.type)
        return view._getvalue()
    if isinstance(kind, types.BaseTuple):
        for i, part in enumerate(cast(Any, kind).types):
            item = builder.insert_value(item, _lent(context, builder, part, builder.extract_value(item, i)), i)
    return item


@infer_getattr
class _BorrowedAttribute(_Template):  # type: ignore[misc]
    key = Borrowed

    def generic_resolve(self, borrowed: Any, name: str) -> Any:
        if name not in borrowed.of.fields:
            return None
        kind = borrowed.of.types[borrowed.of.fields.index(name)]
        return Borrowed(kind) if isinstance(kind, types.BaseNamedTuple) else kind


@_lower_getattr(Borrowed)  # type: ignore[untyped-decorator]
def _read(context: Any, builder: Any, borrowed: Any, address: Any, name: str) -> Any:
    place = borrowed.of.fields.index(name)
    kind, field = borrowed.of.types[place], cast(Any, cgutils.gep_inbounds)(builder, address, 0, place)
    # A tuple inside the tuple is borrowed, too.
    return field if isinstance(kind, types.BaseNamedTuple) else _lent(context, builder, kind, builder.load(field))


@intrinsic
def _borrow(typing: Any, value: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        kind, item = signature.args[0], values[0]
        if isinstance(kind, Borrowed):
            return item
        item = _lent(context, builder, kind, item)
        if isinstance(kind, types.BaseNamedTuple):
            return cast(Any, cgutils.alloca_once_value)(builder, item)
        return item

    kind = Borrowed(value) if isinstance(value, types.BaseNamedTuple) else value
    return kind(value), generate


#: The same array or named tuple, for use within the function that calls this, and within those that it calls.
#:
#: An array is without a reference count, which would cost an atomic operation for each view of it. A named tuple is its
#: address. The argument must outlive the result: borrow only arguments of a function, never arrays that it allocates,
#: because these are freed after their last use by name.
borrow: Callable[[Lent], Lent] = cast(Any, _borrow)
