"""An upper bound of the cycles that a program takes on a Cortex-M4F, from the instructions that it executed.

qemu does not model time. But this processor executes one instruction after another, and its manual says how many cycles
each takes (ARM, Cortex-M4 Technical Reference Manual r0p1, tables 3-1 and 7-1). We let the emulator report every
instruction that it executes and add up these numbers, always the larger one where the manual gives a range: loads and
stores never overlap (2), a branch that is taken refills the pipeline in 3 (4), an integer division takes 12, every
floating-point result is waited for (+1). Memory without wait states, no interrupts.
"""

from __future__ import annotations

import re
import subprocess
from collections.abc import Iterator
from itertools import pairwise

REFILL = 3
SLOW = {
    "vdiv": 15,
    "vsqrt": 15,
    "sdiv": 12,
    "udiv": 12,
    "mla": 2,
    "mls": 2,
    "vmov": 2,
    "vmrs": 1,
    "vcmp": 1,
    "vcmpe": 1,
}
"""Cycles of what is neither a branch, nor memory, nor ordinary arithmetic, which takes 1 and with floats 2."""
MANY = ("push", "pop", "ldm", "stm", "vpush", "vpop", "vldm", "vstm")
CONDITION = r"(eq|ne|cs|hs|cc|lo|mi|pl|vs|vc|hi|ls|ge|lt|gt|le)?"


def disassembled(elf: str) -> dict[int, tuple[int, int]]:
    """Address -> (cycles if execution goes on with the next instruction, its address)."""
    text = subprocess.run(["arm-none-eabi-objdump", "-d", elf], check=True, capture_output=True, text=True).stdout
    found = re.findall(r"^\s*([0-9a-f]+):\t([0-9a-f ]+?)\s*\t(\S+)\s*([^\n]*)$", text, re.M)
    return {int(at, 16): (cost(name, rest), int(at, 16) + len(code.replace(" ", "")) // 2)
            for at, code, name, rest in found}  # fmt: skip


def cost(name: str, operands: str) -> int:
    """Cycles of one instruction that does not branch."""
    base = name.split(".")[0]
    if base.startswith(MANY):
        return 1 + registers(operands)
    if re.fullmatch(rf"v(ldr|str){CONDITION}", base):
        return 3 if re.search(r"\bd\d", operands) else 2
    if re.match(r"(ldr|str)d", base):
        return 3
    if re.match(r"ldr|str", base):
        return 2
    for slow, cycles in SLOW.items():
        if re.fullmatch(rf"{slow}{CONDITION}", base):
            return cycles
    return 2 if base.startswith("v") else 1


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
    for at, then in pairwise(executed(elf)):
        taken, following = known[at]
        instructions += 1
        total += taken + (0 if then == following else REFILL)
    return instructions, total
