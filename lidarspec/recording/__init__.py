"""Everything that came over a link, with its time. In: chunks, or an .lsr file. Out: a file that survives a crash, or its records.

`recorders` take what arrives, by the suffix of the file; `appending` writes it in a thread of its own; `format` are the bytes of an .lsr
file; `recordings` reads them again.
"""
