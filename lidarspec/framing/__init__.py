"""Find frames in bytes: known types and layouts, or counted as invalid.

In: a byte stream in any pieces, or datagrams. Out: `Frames`, a struct of arrays of those that were
found, and counters for all other bytes. No clock, port or thread in here, and no exception for any
bytes whatever. Modules in reading order:

* `results`: `Frames`, which each module passes on to the next; frames one by one; the counters.
* `plausibility`: whether candidates of one layout are frames, many at a time.
* `many_lengths`: candidates of layouts that differ only in the length of an array, judged together.
* `frame_codec`: the interface of the engine of one frame type: its candidates judged,
  and its frames as columns.
* `text_frames`: this engine for frames with a wire form.
* `frame_engine`: this engine for binary frames, by layouts.
* `plain_frames`: this engine for frames without layouts, by construct.
* `weak_frames`: types that are accepted only in runs: the runs among their candidates.
* `candidates`: the candidates in a piece of a stream, of the types that are looked for.
* `search`: the rule of a stream: the leftmost valid candidate, then on after its last byte.
* `steady`: frames at one distance, which need no search: in streams, in datagrams, in arrays.
* `assembly`: messages that come in several datagrams.
* `datagrams`: datagrams of several types.
* `decoder`: all of it, incrementally: what is undecided is looked at again with the next bytes.
* `examples`: valid frames with random content.
"""
