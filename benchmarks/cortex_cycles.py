"""An upper bound of the cycles that a program takes on a Cortex-M4F, from the instructions that it executed.

qemu does not model time. But this processor executes one instruction after another, and its manual says how many cycles
each takes: ARM Cortex-M4 Processor Technical Reference Manual, revision r0p1, document 100166_0001_00, table 3-1
(processor instructions), the list of load and store timings after it, and table 7-1 (floating-point instructions). We
let the emulator report every instruction that it executes and add up these numbers, always the larger one where the
manual gives a range or says "might":

* loads and stores take 2, or 1 + N for N words, and never overlap; from a constant beside the code (relative to pc)
  1 more, and 1 more if the instruction before computes the address;
* whatever changes the flow of the program refills the pipeline in 3, the most that P can be;
* an integer division takes 12, a floating-point division or square root 14, a multiplication with accumulation 3, and
  every result of floating-point arithmetic is waited for, 1 more.

Memory without wait states, no interrupts.
"""

from __future__ import annotations

import re
import subprocess
from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

REFILL = 3
SLOW = {
    r"v(div|sqrt)": 14,
    r"vf?n?m(la|ls)": 3,
    r"vfn?m[as]": 3,
    r"[su]div": 12,
    r"tb[bh]": 3,
}
"""Cycles of what is neither memory nor ordinary arithmetic, which takes 1."""
MANY = ("push", "pop", "ldm", "stm", "vpush", "vpop", "vldm", "vstm")
CONDITION = r"(eq|ne|cs|hs|cc|lo|mi|pl|vs|vc|hi|ls|ge|lt|gt|le)?"
NO_RESULT = re.compile(r"(v|ldr|str|cmp|cmn|tst|teq|b|cb|it|nop|svc|bkpt)(?!ic|f)")
"""Instructions that leave nothing in a core register, or not by data processing."""


class Instruction(NamedTuple):
    """One instruction: its cycles if execution goes on with the next one, whose address is ``following``."""

    cycles: int
    following: int
    computes: frozenset[str]
    """The core registers that data processing writes."""
    addressed: frozenset[str]
    """The core registers that an address in memory is made of."""


def disassembled(elf: str) -> dict[int, Instruction]:
    """The instructions of a program by their addresses."""
    text = subprocess.run(["arm-none-eabi-objdump", "-d", elf], check=True, capture_output=True, text=True).stdout
    found = re.findall(r"^\s*([0-9a-f]+):\t([0-9a-f ]+?)\s*\t(\S+)\s*([^\n]*)$", text, re.M)
    return {int(at, 16): instruction(int(at, 16) + len(code.replace(" ", "")) // 2, name, rest)
            for at, code, name, rest in found}  # fmt: skip


def instruction(following: int, name: str, operands: str) -> Instruction:
    base = name.split(".")[0]
    results = 2 if re.search("mull|mlal", base) else 1
    leaves_none = base.startswith(MANY) or NO_RESULT.match(base)
    computes = frozenset() if leaves_none else frozenset(re.split(r",\s*", operands)[:results])
    if base.startswith(("push", "pop", "vpush", "vpop")):
        addressed = {"sp"}
    elif base.startswith(MANY):
        addressed = set(re.findall(r"^\w+", operands))
    else:
        addressed = {one for inside in re.findall(r"\[([^\]]*)\]", operands) 
                     for one in re.findall(r"[a-z]\w+", inside)}  # fmt: skip
    return Instruction(cost(base, operands), following, computes, frozenset(addressed))


def cost(base: str, operands: str) -> int:
    """Cycles of one instruction that does not branch."""
    beside_code = "[pc" in operands
    if base.startswith(MANY):
        return 1 + registers(operands)
    if re.fullmatch(rf"v(ldr|str){CONDITION}", base):
        return (3 if re.search(r"\bd\d", operands) else 2) + beside_code
    if re.match(r"(ldr|str)d", base):
        return 3 + beside_code
    if re.match(r"ldr|str", base):
        return 2 + beside_code
    cycles = next((cycles for slow, cycles in SLOW.items() if re.fullmatch(slow + CONDITION, base)), 1)
    if re.fullmatch(f"vmrs{CONDITION}", base) or not base.startswith("v"):
        return cycles
    return cycles + 1


def registers(operands: str) -> int:
    """How many words a list of registers means."""
    listed = operands.split("{")[1].split("}")[0]
    count = 0
    for part in listed.split(","):
        ends = [int(digits) for digits in re.findall(r"\d+", part)]
        count += (ends[1] - ends[0] + 1 if len(ends) == 2 else 1) * (2 if part.strip().startswith("d") else 1)
    return count


def executed(elf: str) -> Iterator[int]:
    """The addresses of all instructions that a program executes."""
    options = subprocess.run(["qemu-system-arm", "--help"], check=True, capture_output=True, text=True).stdout
    single = ["-accel", "tcg,one-insn-per-tb=on"] if "one-insn-per-tb" in options else ["-singlestep"]
    log = ["-d", "exec,nochain", "-D", "/dev/stderr"]
    command = ["qemu-system-arm", "-M", "mps2-an386", "-nographic", "-semihosting", *single, *log, "-kernel", elf]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as running:
        assert running.stderr is not None
        for line in running.stderr:
            if line.startswith("Trace"):
                yield int(line.split("[")[1].split("/")[1], 16)


def counted(elf: str) -> tuple[int, int]:
    """(instructions, cycles at most) of a whole run."""
    known, instructions, total = disassembled(elf), 0, 0
    computed: frozenset[str] = frozenset()
    for at, then in pairwise(executed(elf)):
        one = known[at]
        instructions += 1
        total += one.cycles + bool(computed & one.addressed) + (0 if then == one.following else REFILL)
        computed = one.computes
    return instructions, total
