"""Numba's passes as they are used here: without those for what no step has, and with direct access to fields.

Numba makes an array of every field that a step names, with its shape, strides and owner in a structure on the stack,
and then takes the structure apart again to find one entry: some forty instructions of LLVM's language for ``s.y[l]``.
It gives every variable a place on the stack, which is loaded and cleared again, and makes a loop over a range an object
with several such places. LLVM removes nearly all of it, but writing, reading and removing it was a third of the time of
compiling. `Direct` writes what would be left: the place of a field is known from its type, so an address is enough; a
variable that is assigned once is a value; and a range is two numbers. An array, a tuple or a range is made only where
it is used in another way. Addresses and loops have the form that Numba gives them, because the choices of LLVM depend
on it: one lane of twelve parameters took 160 instead of 127 ns while a loop computed its next number before it tested
for its end.

Private parts: `Lower` and the names of its methods, the passes of `DefaultPassBuilder`, and functions that build code
for arrays.
"""

from __future__ import annotations

import math
from functools import reduce
from typing import Any, NamedTuple

from numba import types
from numba.core import ir
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import register_pass
from numba.core.lowering import Lower
from numba.core.postproc import PostProcessor, VariableLifetime
from numba.core.transforms import canonicalize_cfg
from numba.core.typed_passes import NativeLowering
from numba.np.arrayobj import fix_integer_index, load_item, store_item

from driftfit.engine.compile_time.open_record import OpenRecord, beginning, cgutils, lengths, tell_fields_apart

RECORDS = types.Record, OpenRecord
PLAIN = types.Number, types.Boolean, *RECORDS, types.NoneType, types.Function, types.Module, types.Dispatcher
"""Types whose values own no memory, and whose variables need not be cleared."""


class Field(NamedTuple):
    """A field of a record that was named, and not yet used."""

    record: Any
    """The address."""
    kind: Any
    """The type of the record."""
    name: str


class Row(NamedTuple):
    """The entries of a tuple, of a range (start and stop), or of a pair that was not yet made."""

    kind: Any
    """Its type."""
    entries: list[Any]


class Loop(NamedTuple):
    """A loop over a range: its type and end, and addresses of the number, of the next one and of how many are left."""

    kind: Any
    stop: Any
    now: Any
    next: Any
    left: Any


class Direct(Lower):
    """Numba's step from typed code to LLVM's language, with fewer instructions for the same code."""

    def _find_singly_assigned_variable(self) -> None:
        """Variables that need no place on the stack: assigned once, before every use.

        Numba's own are those that are used in one block only.
        """
        self._later: dict[str, Any] = {}
        self._tables: dict[Any, Any] = {}
        self._direct = not self._disable_sroa_like_opt and not self.func_ir.func_id.is_generator
        if not self._direct:
            super()._find_singly_assigned_variable()
            return
        self._blk_local_varmap: dict[str, Any] = {}
        self._once, elsewhere = self._assigned_before_use()
        self._singly_assigned_vars = {name for name in self._once if name not in elsewhere or self._is_plain(name)}

    def _assigned_before_use(self) -> tuple[set[str], set[str]]:
        """Variables that are assigned once, in a block through which every way to their uses leads; and all that are
        used in a block that does not assign them first.
        """
        blocks = self.func_ir.blocks
        places: dict[str, Any] = {}
        for label, block in blocks.items():
            for one in block.body:
                if isinstance(one, ir.Assign):
                    name = one.target.name
                    places[name] = label if name not in places else None
        known = self.func_ir.variable_lifetime
        uses, above = known.usedefs.usemap, known.cfg.dominators()
        for label, used in uses.items():
            for name in used:
                place = places.get(name)
                if place is not None and (place >= label or place not in above[label]):
                    places[name] = None
        return {name for name, place in places.items() if place is not None}, set().union(*uses.values())

    def _is_plain(self, name: str) -> bool:
        """Whether values of a variable own no memory."""
        return isinstance(self.typeof(name), PLAIN)

    def pre_block(self, block: Any) -> None:
        """Arrays and addresses that were made in one block are not used in another."""
        self._made: dict[Any, Any] = {}
        super().pre_block(block)

    def lower(self) -> None:
        """Lower a function. Instructions and their block refer to each other until the garbage collector finds them."""
        super().lower()
        for function in self.module.functions:
            for block in function.blocks:
                block.instructions.clear()

    def lower_inst(self, inst: Any) -> Any:
        """Lower one instruction, or remember it for later."""
        if isinstance(inst, ir.Assign) and self._direct and inst.target.name in self._once:
            later = self._put_off(inst.value, self.typeof(inst.target.name))
            if later is not None:
                self._later[inst.target.name] = later
                return None
        elif isinstance(inst, ir.Del) and self._direct and (inst.value in self._later or self._is_plain(inst.value)):
            return None
        return super().lower_inst(inst)

    def storevar(self, value: Any, name: str, argidx: int | None = None) -> None:
        """Store a value in a variable; what it held before matters only if that owns memory."""
        if not self._direct or not self._is_plain(name):
            super().storevar(value, name, argidx)
        elif name in self._singly_assigned_vars:
            self._blk_local_varmap[name] = value
        else:
            self.builder.store(value, self.getvar(name))

    def _put_off(self, expr: Any, kind: Any) -> Any:
        """What is remembered of an expression, if it is one that can be put off."""
        if isinstance(expr, ir.Var):
            return self._later.get(expr.name) if self.typeof(expr.name) == kind else None
        if not isinstance(expr, ir.Expr):
            return None
        find = getattr(self, f"later_{expr.op}", None)
        return find and find(expr, kind)

    def later_getattr(self, expr: Any, kind: Any) -> Field | Row | None:
        if isinstance(kind, types.Array) and isinstance(self.typeof(expr.value.name), RECORDS):
            return Field(self.loadvar(expr.value.name), self.typeof(expr.value.name), expr.attr)
        field = self._later.get(expr.value.name)
        if expr.attr == "shape" and isinstance(field, Field):
            return Row(kind, self._shape(field))
        return None

    def later_build_tuple(self, expr: Any, kind: Any) -> Row | None:
        if not all(isinstance(one, types.Integer) for one in kind):
            return None
        return Row(kind, [self._cast(one.name, to) for one, to in zip(expr.items, kind, strict=True)])

    def later_exhaust_iter(self, expr: Any, kind: Any) -> Row | None:
        row = self._later.get(expr.value.name)
        return row if isinstance(row, Row) and len(row.entries) == expr.count else None

    def later_call(self, expr: Any, kind: Any) -> Row | None:
        function = self.typeof(expr.func.name)
        if not isinstance(function, types.Function) or function.typing_key is not range or expr.kws or expr.vararg:
            return None
        if kind != types.range_state64_type or len(expr.args) > 2:
            return None
        given = [self._cast(one.name, types.int64) for one in expr.args]
        return Row(kind, [*([self._whole(0)] * (2 - len(given))), *given])

    def later_getiter(self, expr: Any, kind: Any) -> Loop | None:
        row = self._later.get(expr.value.name)
        if row is None or row.kind != types.range_state64_type:
            return None
        start, stop = row.entries
        now, following, left = (cgutils.alloca_once(self.builder, start.type) for _ in range(3))
        self.builder.store(start, following)
        self.builder.store(stop if _is(start, 0) else self.builder.sub(stop, start), left)
        return Loop(kind, stop, now, following, left)

    def later_iternext(self, expr: Any, kind: Any) -> Row | None:
        loop = self._later.get(expr.value.name)
        if not isinstance(loop, Loop):
            return None
        builder, left = self.builder, self.builder.load(loop.left)
        valid = builder.icmp_signed(">", left, left.type(0))
        with builder.if_then(valid):
            number = builder.load(loop.next)
            builder.store(number, loop.now)
            builder.store(builder.sub(left, left.type(1), flags=("nsw",)), loop.left)
            builder.store(builder.add(number, number.type(1)), loop.next)
        return Row(kind, [builder.load(loop.now), valid])

    def _whole(self, number: int) -> Any:
        return self.context.get_constant(types.intp, number)

    def _cast(self, name: str, to: Any) -> Any:
        return self.context.cast(self.builder, self.loadvar(name), self.typeof(name), to)

    def loadvar(self, name: str) -> Any:
        """The value of a variable; what was put off is made now."""
        later = self._later.get(name)
        if later is None:
            return super().loadvar(name)
        if name not in self._made:
            self._made[name] = self._make(later)
        return self._made[name]

    def _make(self, later: Any) -> Any:
        """The value of what was put off, as Numba makes it."""
        context, builder = self.context, self.builder
        if isinstance(later, Field):
            return context.get_getattr(later.kind, later.name)(context, builder, later.kind, later.record, later.name)
        if isinstance(later, Row) and isinstance(later.kind, types.BaseTuple):
            return context.make_tuple(builder, later.kind, later.entries)
        made = cgutils.create_struct_proxy(later.kind)(context, builder)
        if isinstance(later, Loop):
            made.iter, made.stop, made.step, made.count = later.next, later.stop, self._whole(1), later.left
        elif isinstance(later.kind, types.RangeType):
            (made.start, made.stop), made.step = later.entries, self._whole(1)
        else:
            made.first, made.second = later.entries
        return made._getvalue()

    def lower_expr(self, resty: Any, expr: Any) -> Any:
        """Lower an expression; an entry of what was not made is that entry."""
        place: Any = expr.index if expr.op == "static_getitem" else {"pair_first": 0, "pair_second": 1}.get(expr.op)
        row = self._later.get(expr.value.name) if isinstance(place, int) else None
        if isinstance(place, int) and isinstance(row, Row):
            entry = row.entries[place]
            return (
                entry if expr.op != "static_getitem" else self.context.cast(self.builder, entry, row.kind[place], resty)
            )
        return super().lower_expr(resty, expr)

    def lower_getitem(self, resty: Any, expr: Any, value: Any, index: Any, signature: Any) -> Any:
        """Read an entry."""
        place = self._place(value, index)
        if place is None:
            return super().lower_getitem(resty, expr, value, index, signature)
        array, pointer = place
        entry = load_item(self.context, self.builder, array, pointer)
        self._mark(value, self.builder.block.instructions[-1])
        return self.context.cast(self.builder, entry, array.dtype, resty)

    def lower_setitem(self, target_var: Any, index_var: Any, value_var: Any, signature: Any) -> Any:
        """Write an entry."""
        place = self._place(target_var, index_var)
        if place is None:
            return super().lower_setitem(target_var, index_var, value_var, signature)
        array, pointer = place
        store_item(self.context, self.builder, array, self._cast(value_var.name, array.dtype), pointer)
        self._mark(target_var, self.builder.block.instructions[-1])
        return self.context.get_dummy_value()

    def _mark(self, value: Any, access: Any) -> None:
        """Mark an instruction that reads or writes an entry of a field."""
        field = self._later[value.name]
        if isinstance(field.kind, OpenRecord):
            tell_fields_apart(self.builder, field.name, access)

    def _place(self, value: Any, index: Any) -> tuple[Any, Any] | None:
        """The type of a field and the address of one of its entries, if a field and an entry are meant."""
        field = self._later.get(value.name)
        if not isinstance(field, Field):
            return None
        array, kind = _array(field), self.typeof(index.name)
        kinds = list(kind) if isinstance(kind, types.BaseTuple) else [kind]
        if len(kinds) != array.ndim or not all(isinstance(one, types.Integer) for one in kinds):
            return None
        return array, self._address(field, kinds, self._entries(index.name))

    def _entries(self, name: str) -> list[Any]:
        """The values of an index."""
        row = self._later.get(name)
        if isinstance(row, Row):
            return row.entries
        value, kind = self.loadvar(name), self.typeof(name)
        return cgutils.unpack_tuple(self.builder, value, len(kind)) if isinstance(kind, types.BaseTuple) else [value]

    def _shape(self, field: Field) -> list[Any]:
        """The lengths of the axes of a field."""
        if not isinstance(field.kind, OpenRecord):
            return [self._whole(n) for n in _array(field).shape]
        return list(self._looked_up(lengths, field))

    def _first(self, field: Field) -> Any:
        """The address of the first entry of a field, computed once in a block."""
        if isinstance(field.kind, OpenRecord):
            return self._looked_up(beginning, field)
        context, builder = self.context, self.builder
        key = field.record, field.kind.offset(field.name)  # two types of one record may have fields of one name
        if key not in self._made:
            context.sentry_record_alignment(field.kind, field.name)
            data = context.get_data_type(_array(field).dtype)
            self._made[key] = cgutils.get_record_member(builder, *key, data)
        return self._made[key]

    def _looked_up(self, look: Any, field: Field) -> Any:
        """What the table of an open record says of a field: once for a function that is given the record."""
        context, builder, key = self.context, self.builder, (look, field.record, field.name)
        if getattr(field.record, "parent", None) is not builder.function.entry_basic_block:
            return look(context, builder, field.record, field.kind, field.name)
        if key not in self._tables:
            with builder.goto_entry_block():
                self._tables[key] = look(context, builder, field.record, field.kind, field.name)
        return self._tables[key]

    def _address(self, field: Field, kinds: list[Any], entries: list[Any]) -> Any:
        """The address of an entry."""
        first, shape, builder = self._first(field), self._shape(field), self.builder
        place = None
        for axis, (kind, given, count) in enumerate(zip(kinds, entries, shape, strict=True)):
            entry = self._from_the_beginning(kind, given, count)
            step = self._product(shape[axis + 1 :])
            entry = entry if _is(step, 1) else builder.mul(entry, step)
            place = entry if place is None else builder.add(place, entry)
        return builder.gep(first, [place])

    def _product(self, lengths: list[Any]) -> Any:
        """The number of entries of some axes: a constant if they are."""
        if all(hasattr(one, "constant") for one in lengths):
            return self._whole(math.prod(one.constant for one in lengths))
        return reduce(self.builder.mul, [one for one in lengths if not _is(one, 1)])

    def _from_the_beginning(self, kind: Any, given: Any, count: Any) -> Any:
        """An index of which a negative one counts from the end."""
        key = kind, given, getattr(count, "constant", count)
        if _is_natural(given):
            return given
        if key not in self._made:
            self._made[key] = fix_integer_index(self.context, self.builder, kind, given, count)
        return self._made[key]


def _array(field: Field) -> Any:
    """The type of a field."""
    return field.kind.typeof(field.name)


def _is_natural(value: Any) -> bool:
    """Whether a value is a constant that is not negative."""
    known = getattr(value, "constant", None)
    return isinstance(known, int) and known >= 0 and value.type.width == 64


def _is(value: Any, number: int) -> bool:
    return getattr(value, "constant", None) == number


def _analyse(self: PostProcessor, emit_dels: bool = False, extend_lifetimes: bool = False) -> None:
    """Numba's analysis of a function, repeated after four of its passes: where variables are needed for the last
    time, for generators and loops that are compiled apart, of which nothing here has any. It is left out here until
    the last pass asks, which was a tenth of the time in Python.
    """
    function = self.func_ir
    if function.is_generator or not getattr(function.func_id, "direct", False):
        _analyse_all(self, emit_dels, extend_lifetimes)
        return
    function.blocks = canonicalize_cfg(function.blocks)
    function.variable_lifetime = VariableLifetime(function.blocks)
    function.generator_info = None
    if emit_dels:
        self._insert_var_dels(extend_lifetimes)


_analyse_all = PostProcessor.run
PostProcessor.run = _analyse


@register_pass(mutates_CFG=True, analysis_only=False)
class DirectLowering(NativeLowering):
    """Numba's pass with `Direct`."""

    _name = "direct_lowering"

    @property
    def lowering_class(self) -> Any:
        """What lowers a function."""
        return Direct


UNUSED = {
    "LiteralPropagation", "annotate_types", "dump_parfor_diagnostics", "inline_closure_likes", "inline_inlinables",
    "inline_overloads", "literal_unroll", "make_function_op_code_to_jit_function", "nopython_rewrites", "with_lifting",
}  # fmt: skip
"""Passes for comprehensions, inner functions, expressions of whole arrays and ``with``, which nothing here has."""


class Pipeline(CompilerBase):
    """Numba's passes without those, which take 6 per cent of the time of compiling, and with `Direct`."""

    def define_pipelines(self) -> list[Any]:
        """The one way through the compiler."""
        made = DefaultPassBuilder.define_nopython_pipeline(self.state)
        ours = {NativeLowering: DirectLowering}
        made.passes = [(ours.get(one, one), why) for one, why in made.passes if one.name() not in UNUSED]
        self.state.func_id.direct = True
        return [made]
