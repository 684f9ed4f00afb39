"""A Spark session on this computer, with a clear message where something that it needs is missing."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from typing import Any

JAVA = (17, 21)
"""Versions of Java with which PySpark 4 runs."""


def java() -> tuple[str | None, int | None]:
    """(the path of Java, its version); None where there is none."""
    home = os.environ.get("JAVA_HOME")
    path = shutil.which("java", path=os.path.join(home, "bin")) if home else shutil.which("java")
    if path is None:
        return None, None
    printed = subprocess.run([path, "-version"], capture_output=True, text=True, check=False).stderr
    found = re.search(r'version "(\d+)', printed)
    return path, int(found[1]) if found else None


def missing() -> str:
    """What is missing to run Spark here, in a sentence; empty if nothing is."""
    try:
        import pyspark
    except ImportError:
        return "driftfit.bridges.spark needs PySpark: pip install driftfit[spark]"
    if int(pyspark.__version__.split(".")[0]) < 4:
        return f"driftfit.bridges.spark needs PySpark 4; this is {pyspark.__version__}: pip install driftfit[spark]"
    path, version = java()
    if path is None:
        return (
            "Spark needs Java 17 or 21, and no java is on the PATH or in JAVA_HOME: install it, as by "
            "apt-get install openjdk-17-jre-headless."
        )
    if version is not None and version < JAVA[0]:
        return f"Spark needs Java 17 or 21; {path} is version {version}. Install one and set JAVA_HOME."
    return ""


def session(master: str = "local[2]", **settings: Any) -> Any:
    """A session of Spark, with what suits this package.

    Parameters
    ----------
    master : str
        Where it runs; "local[2]" is two cores of this computer.
    settings : str
        Further settings of Spark, with "__" in place of dots: ``spark__driver__memory="4g"``.

    Raises
    ------
    ImportError
        If PySpark or Java is missing or too old.
    """
    if problem := missing():
        raise ImportError(problem)
    from pyspark.sql import SparkSession

    builder = SparkSession.builder.master(master).appName("driftfit")
    given = {name.replace("__", "."): value for name, value in settings.items()}
    usual = {
        "spark.sql.session.timeZone": "UTC",
        "spark.ui.showConsoleProgress": "false",
        "spark.sql.shuffle.partitions": "8",
        "spark.sql.execution.arrow.maxRecordsPerBatch": "32000",
        "spark.sql.maxConcurrentOutputFileWriters": "8",  # a batch is written by kind without being sorted again
    }
    if master.startswith("local"):  # the workers are this interpreter, whichever comes first on the PATH
        os.environ.setdefault("PYSPARK_PYTHON", sys.executable)
    for name, value in {**usual, **given}.items():
        builder = builder.config(name, value)
    return builder.getOrCreate()
