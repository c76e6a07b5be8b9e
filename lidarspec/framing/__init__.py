"""Find frames in bytes: known types and layouts, or counted as invalid.

In: a byte stream in any pieces, or datagrams. Out: `Frames`, a struct of arrays of the
frames, and counters for all other bytes. Nothing here uses a clock, a port or a thread, and no
input bytes raise an exception. Modules in reading order:

* `results`: `Frames`, many frames as arrays; `Found`, one frame; `Counters`.
* `plausibility`: checks of many candidates of one layout at a time.
* `variable_lengths`: joint checks of candidates whose layouts differ only in an array's length.
* `frame_codec`: the interface of the engine of one frame type: checks of candidates, and tables
  of frames.
* `text_frames`: the engine of frames with a wire form.
* `frame_engine`: the engine of binary frames, by layouts.
* `plain_frames`: the engine of frames without layouts, by construct.
* `weak_frames`: the runs of frame types that are accepted only in runs.
* `candidates`: the candidates of all searched types in a piece of a stream.
* `search`: the search of a stream for the leftmost valid candidates.
* `regular_rows`: frames at equal distances, which need no search.
* `datagram_assembly`: messages in several datagrams, joined before framing.
* `datagrams`: datagrams of several types.
* `decoder`: `Decoder`, the incremental interface to all of these.
* `example_frames`: valid frames with random content.
"""
