"""A source consists of options and two methods. A new source is one file in this folder, with a class of its name.

    class Mine(Source):                         # src/driftfit/service/sources/mine.py, kind = "mine"
        url: str                                # options are the fields of a frozen dataclass
        def open(self, position): ...           # connect; position is where the last run had come to, or None
        def read(self, wait): ...               # a Batch with an acknowledgement, or None if nothing came

`read` is called repeatedly in a separate thread. It blocks for at most ``wait`` seconds. The acknowledgement
of a batch is called, from the thread of the journal, after its samples are on disk. An exception means that the source
is away: it is closed, and opened again after a pause of 1 s, 2 s, ... 60 s.
"""
