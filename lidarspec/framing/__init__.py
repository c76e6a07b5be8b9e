"""Find frames in bytes: known types and layouts, or counted as invalid.

In: a byte stream in any pieces, or datagrams. Out: `Frames`, a struct of arrays of the
frames, and counters for all other bytes. Nothing here uses a clock, a port or a thread, and no
input bytes raise an exception. Modules in reading order:

* `results`: `Frames`, which each module passes on to the next; frames one by one; the counters.
* `plausibility`: whether candidates of one layout are frames, many at a time.
* `variable_lengths`: judge candidates together whose layouts differ only in an array's length.
* `frame_codec`: the interface of the engine of one frame type: its candidates judged,
  and its frames as columns.
* `text_frames`: this engine for frames with a wire form.
* `frame_engine`: this engine for binary frames, by layouts.
* `plain_frames`: this engine for frames without layouts, by construct.
* `weak_frames`: types that are accepted only in runs: the runs among their candidates.
* `candidates`: the candidates in a piece of a stream, of the types that are looked for.
* `search`: the rule of a stream: the leftmost valid candidate, then on after its last byte.
* `regular_rows`: frames at one distance, which need no search: in streams, in datagrams, in arrays.
* `datagram_assembly`: messages that come in several datagrams.
* `datagrams`: datagrams of several types.
* `decoder`: all of it, incrementally: what is undecided is looked at again with the next bytes.
* `example_frames`: valid frames with random content.
"""
