"""The compiler's decorator, with a cache on disk that no change of the sources outlives; and borrowed tuples of arrays.

numba keys its cache by the one file a function stands in, while the compiled code holds every function it calls: after
a change of one file it would go on running the old code of the others. So the key holds a stamp of all files that
compiled code may call: those of the folders below, as compiled functions elsewhere are private to their own file.

numba passes a tuple by its parts. A hundred arrays are a thousand numbers, which every call would copy, and which every
function compiled for such a call would take apart and put together again. A borrowed tuple stands in memory, and
functions are given its address.
"""

from __future__ import annotations

import gc
import hashlib
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

from llvmlite.binding import parse_assembly
from numba import __version__ as numba_version
from numba import njit, types
from numba.core import cgutils, config
from numba.core.caching import CompileResultCacheImpl, IndexDataCacheFile, NullCache
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompileResult, Flags, compile_extra
from numba.core.compiler_lock import global_compiler_lock
from numba.core.datamodel import models
from numba.core.datamodel.registry import register_default
from numba.core.runtime.nrt import rtsys
from numba.core.targetconfig import ConfigStack
from numba.core.types.functions import BaseFunction
from numba.core.typing.templates import AttributeTemplate, make_concrete_template
from numba.extending import infer_getattr, intrinsic, lower_getattr_generic
from numba.np.arrayobj import make_array

from fingerspice.base.announcing import Compiling
from fingerspice.base.errors import InputError

Function = TypeVar("Function", bound=Callable[..., Any])
_PACKAGE = Path(__file__).resolve().parents[1]
#: Folders whose functions compiled code of other files may call.
SHARED_FOLDERS = ("engine", "numerics", "physics")
_OWN = Path(__file__).resolve()
_SOURCES = [_OWN, *sorted(p for name in SHARED_FOLDERS for p in (_PACKAGE / name).rglob("*.py"))]
#: Hash of the compiled code's sources. By content, so that a package that is copied, or packed into an image, keeps its
#: compiled code.
STAMP = hashlib.sha256(b"".join(p.name.encode() + p.read_bytes() for p in _SOURCES)).hexdigest()
_V2 = {"cx16", "popcnt", "sahf", "sse3", "sse4.1", "sse4.2", "ssse3"}
#: Processors for which a wheel may hold compiled code, the best first, each with the instruction sets that it has.
LEVELS = {
    "x86-64-v3": _V2 | {"avx", "avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe", "xsave"},
    "x86-64-v2": _V2,
    "generic": {"neon"},
}
#: Folder of the compiled code that came with the package.
_CAME = _PACKAGE / "objects"
_MADE_BY = f"{sys.implementation.cache_tag}-numba-{numba_version}"
_COMPILER = Compiling()


def _drop_stale_cache() -> None:
    """Delete cached code in the package that no name fits any more."""
    with suppress(OSError):
        for file in (_OWN.parent / "__pycache__").glob("*.nbc"):
            if STAMP[:12] not in file.name:
                file.unlink(missing_ok=True)


@cache
def _kept() -> Any:
    """numba's choice of a folder that can be written, NUMBA_CACHE_DIR, this file's or the user's; None without any."""
    with suppress(RuntimeError):
        return cast(Any, CompileResultCacheImpl)(_of_kind)
    return None


def cache_folder() -> str | None:
    """Folder where compiled code is kept; None if none can be written."""
    return None if _kept() is None else str(_kept().locator.get_cache_path())


@cache
def _folders() -> list[Any]:
    """Folders of compiled code: where it is kept, this file's, and the one that came with the package."""
    folders = [p for p in (cache_folder(), _OWN.parent / "__pycache__", _CAME) if p is not None]
    return [cast(Any, IndexDataCacheFile)(str(p), "", "") for p in folders]


@cache
def _source(file: str) -> str:
    """Hash of a file; empty for those in the stamp."""
    return "" if Path(file) in _SOURCES else hashlib.sha256(Path(file).read_bytes()).hexdigest()


def _why() -> str:
    """Why the code that came with the package, if there is any, is not used."""
    came = sorted({file.name.partition("--")[0] for file in _CAME.glob("*.nbc")})
    other = "other processors, arguments or sources" if _MADE_BY in came else ", ".join(came)
    return f"; the compiled code that came with the package is for {other}" if came else ""


class _Cache(NullCache):
    """Compiled code of a function on the disk, a file for each signature and processor, found by the hash of its key.

    There is no index, which processes that compile at once could spoil, and which takes as long to read as the code.
    Code for the processor itself is looked for first, then code for a level of instructions that the processor has,
    as wheels hold it. A file that cannot be read, or that is damaged, counts as absent. If the disk is full, the next
    process compiles again. Compilation is announced, because it takes long.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function, self._name = function, f"{function.__module__}.{function.__qualname__}"

    def _files(self, sig: Any, codegen: Any) -> Iterator[str]:
        code = self._function.__code__
        key = hashlib.sha256(repr((_MADE_BY, STAMP, sig, code.co_code, _source(code.co_filename))).encode())
        triple, cpu, features = codegen.magic_tuple()
        # A processor's name stands for tuning as well; only its instruction sets matter.
        has = {x[1:] for x in features.split(",") if x.startswith("+")}
        for target in [(cpu, features), *((level, "") for level, needed in LEVELS.items() if needed <= has)]:
            whole = key.copy()
            whole.update(repr((triple, target)).encode())
            yield f"{_MADE_BY}--{STAMP[:12]}--{self._name}--{whole.hexdigest()[:24]}.nbc"

    def load_overload(self, sig: Any, context: Any) -> Any:
        """The code for a signature; None where it has to be compiled, which is announced."""
        # What compiled code needs while it runs; numba prepares for compiling as well, which takes as long as a run.
        rtsys.initialize(context)
        for file in self._files(sig, context.codegen()):
            for folder in _folders():
                # Damaged files raise whatever their bytes happen to say.
                with suppress(Exception):
                    seal, data = folder._load_data(file)
                    if seal == _sealed(data):
                        return cast(Any, CompileResult)._rebuild(context, *data)
        kind = getattr(sig[0], "instance_class", None) if sig else None
        name = self._name.removeprefix("fingerspice.")
        _COMPILER.begins(name, kind.__name__ if kind else "", _kept() is not None, _why())
        return None

    def save_overload(self, sig: Any, cres: Any) -> None:
        """Keep the code for a signature, if there is a folder for it."""
        if _kept() is not None and _kept().check_cachable(cres):
            with suppress(OSError):
                data = _packed(cres)
                _folders()[0]._save_data(next(self._files(sig, cres.codegen)), (_sealed(data), data))


def _sealed(data: Any) -> str:
    """Hash of the object code, so that code of which the disk lost a part is never run."""
    return hashlib.sha256(data[0][2][0]).hexdigest()


def _packed(cres: Any) -> Any:
    """What numba keeps of compiled code, but for a listing, and for the code that compiled code calls: it is made anew.

    These are three quarters. numba wants to know which names the object code defines. Environments without constants
    are of no use to it, and reading them would import all of numba that was inlined, and scipy.
    """
    (name, kind, (code, _)), *rest, environments = cres._replace(type_annotation="")._reduce()
    module = cres.library._final_module
    defined = {x.name for group in (module.functions, module.global_variables) for x in group if not x.is_declaration}
    names = parse_assembly("\n".join(f'@"{x}" = global i8 0' for x in sorted(defined)))
    return (name, kind, (code, names.as_bitcode())), *rest, tuple(x for x in environments if x.consts)


class _Body(JITCodeLibrary):
    """Code of a function that compiled code calls, never run by itself.

    It is optimised with its callers, whose module holds it, and not before: otherwise a function that others call, and
    these again others, is optimised as many times.
    """

    def _finalize_final_module(self) -> None:
        cast(Any, self)._finalize_dynamic_globals()
        self._finalized = True

    def _optimize_final_module(self) -> None:
        return


_FOUND: dict[Any, Any] = {}
_find: Any = BaseFunction.get_call_type


def _call_type(function: Any, context: Any, args: Any, kws: Any) -> Any:
    """What numba finds for a call of its own functions, kept by types: it tries all that a `+` may mean, each time."""
    flags = cast(Any, ConfigStack).top_or_none()
    kind = flags and (flags.error_model, *sorted(flags.fastmath.flags))
    key = (context, function.typing_key, args, tuple(kws.items()), kind)
    found = _FOUND.get(key)
    if found is None or found.args not in function._impl_keys:
        found = _FOUND[key] = _find(function, context, args, kws)
    return found


@contextmanager
def _swiftly() -> Iterator[None]:
    """Context of a compilation, without collection of cycles: it makes millions of objects that live until it ends.

    At LLVM's second level of optimisation: the third takes a tenth longer for code that is no faster.
    """
    looking, level = gc.isenabled(), cast(Any, config).OPT
    gc.disable()
    cast(Any, config).OPT = min(level, type(level)(2))
    cast(Any, BaseFunction).get_call_type = _call_type
    try:
        yield
    finally:
        cast(Any, BaseFunction).get_call_type = _find
        cast(Any, config).OPT = level
        if looking:
            gc.enable()


class _Called:
    """A function as compiled code calls it: without machine code of its own, and without a wrapper for Python.

    numba would make and store both for every function, although functions are inlined into their callers.
    """

    def __init__(self, dispatcher: Any, noalias: bool) -> None:
        self.of, self.noalias = dispatcher, noalias
        self.found: dict[Any, tuple[object, Any]] = {}

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """numba's query at a call: the signature, with the function compiled for it."""
        pysig, args = self.of.fold_argument_types(args, kws)
        args = tuple(args)
        with cast(Any, global_compiler_lock):
            if args not in self.found:
                self.found[args] = self._compile(args)
        name = self.of.py_func.__name__
        signatures = [cres.signature for _, cres in self.found.values()]
        return cast(Any, make_concrete_template)(f"CallTemplate({name})", name, signatures), pysig, args, {}

    def get_overload(self, args: Any) -> object:
        """Key under which numba knows the function compiled for these arguments."""
        return self.found[tuple(args)][0]

    def _compile(self, args: Any) -> tuple[object, Any]:
        of, context = self.of, self.of.targetctx
        flags: Any = cast(Any, Flags)()
        of.targetdescr.options.parse_as_flags(flags, of.targetoptions)
        flags.no_compile = flags.no_cpython_wrapper = flags.no_cfunc_wrapper = True
        flags.noalias = self.noalias
        library = cast(Any, _Body)(context.codegen(), of.py_func.__qualname__)
        cres = cast(Any, compile_extra)(of.typingctx, context, of.py_func, args, None, flags, {}, library)
        key = object()
        context.insert_user_function(key, cres.fndesc, [cres.library])
        return key, cres


def _cached(*, noalias: bool = False, **options: Any) -> Callable[[Function], Function]:
    """`njit` with a cache; `noalias`: where compiled code calls it, it writes to no memory that it reads."""

    def compile_when_called(function: Function) -> Function:
        # numba would take options that are missing here from whichever caller comes first. No C code calls a function.
        always = {"error_model": "numpy", "nogil": True, "fastmath": False, "no_cfunc_wrapper": True}
        compiled = njit(**{**always, **options})(function)
        compiled._cache = _Cache(function)
        compile_signature = compiled.compile

        def announced(signature: Any) -> Any:
            with _COMPILER.around(), _swiftly():
                return compile_signature(signature)

        compiled.compile = announced
        called = _Called(compiled, noalias)
        compiled.get_call_template, compiled.get_overload = called.get_call_template, called.get_overload
        return cast(Function, compiled)

    return compile_when_called


def _of_kind(*given: Any) -> Any:
    """What `jit_by_kind` stands for; never run."""
    raise NotImplementedError


def jit_by_kind(**functions: Callable[..., Any]) -> Any:
    """In compiled code one of several functions, chosen by the class of the first argument.

    They are given by the names of the classes, which are named tuples, and take the same arguments.
    """
    chosen: Any = njit(_of_kind)

    def called(args: Any) -> Any:
        return functions[args[0].instance_class.__name__]

    chosen.get_call_template = lambda args, kws: called(args).get_call_template(args, kws)
    chosen.get_overload = lambda args: called(args).get_overload(args)
    return chosen


if cast(Any, config).DISABLE_JIT:
    raise InputError("NUMBA_DISABLE_JIT is set: uncompiled, a run of seconds would take a day; allowed: unset, or 0")
_drop_stale_cache()
# A division by zero is an infinity that the step control refuses, not an exception out of compiled code.
jit = _cached()
# For loops over the rows of a step: with fused multiplication and addition, and with sums that may be reordered
# (always alike), so that they vectorise. Outputs share no memory with inputs: otherwise every loop would be compiled
# twice, with a test before it.
jit_fused = _cached(fastmath={"contract"}, noalias=True)
jit_rows = _cached(fastmath={"contract", "reassoc"}, noalias=True)
# Inlined by LLVM: a call with a tuple of arrays would cost as much as the work.
jit_within = _cached(forceinline=True)
# The same for what holds such loops: the caller's options do not reach what it inlines.
jit_within_rows = _cached(forceinline=True, fastmath={"contract"})


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
