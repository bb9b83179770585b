"""The flows of a sequence, and the tracks of its moving objects."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy.typing as npt

from . import _arrays, _native, _options
from ._flow import Flow, Progress, of_answer

if TYPE_CHECKING:
    from typing_extensions import Unpack


class Sequence:
    """The flows of the consecutive pairs of a sequence, sweep by sweep.

    With preset `label` a pair is estimated from up to five sweeps around it, so its flow comes some sweeps later.
    Memory does not grow with the length of the sequence.

    Args:
        track: keeps tracks of moving objects, and gives flows the motions of tracks that their pairs missed.
        device: as in `flow`.
        threads: as in `flow`.
        options: as in `Options`; the preset is `label` where not given.
    """

    def __init__(
        self,
        *,
        track: bool = False,
        device: str = "auto",
        threads: int | None = None,
        **options: Unpack[_options.Options],
    ) -> None:
        json = _options.as_json({"preset": "label", **options})
        self._native = _native.Sequence(json, device=device, threads=threads, track=track)

    def push(
        self,
        points: Any,
        *,
        ground: Any = None,
        times: Any = None,
        ego: Any = None,
        dt_s: float | None = None,
        deadline: float | None = None,
        progress: Progress | None = None,
    ) -> list[Flow]:
        """Adds the next sweep, N x 3 metres, and returns the flows that are complete with it, in order.

        Args:
            points: the sweep, in its sensor's frame.
            ground: N flags: the ground points. Presets that keep the ground use them with `ground="mask"` alone.
            times: N seconds after the sweep's time.
            ego: the 4 x 4 motion to this sweep's frame from that of the sweep before, where it is known.
            dt_s: seconds from the sweep before.
            deadline: seconds for this call, after which the best flow so far is returned.
            progress: as in `flow`.

        Raises:
            InputError: the sweep or the next pair is refused. The sequence is as before: the same sweep may be pushed
                again, with other arguments. All flows before the pair have been returned. To go on, begin another
                sequence with the sweeps after the pair.
        """
        sweep = _arrays.points("points", points)
        answers = self._native.push(
            sweep,
            mask=None if ground is None else _arrays.mask("the ground mask", ground),
            times=None if times is None else _arrays.times("times", times, sweep),
            ego=None if ego is None else _arrays.matrix("ego", ego),
            dt_s=dt_s,
            deadline=deadline,
            progress=progress,
        )
        return [of_answer(answer) for answer in answers]

    def finish(self, *, deadline: float | None = None, progress: Progress | None = None) -> list[Flow]:
        """Returns the remaining flows at the end of the sequence, in order.

        They end before a pair that is refused; another call then raises why.
        """
        answers = self._native.finish(deadline=deadline, progress=progress)
        return [of_answer(answer) for answer in answers]

    def tracks(self) -> npt.NDArray[Any] | None:
        """The tracks of the flows that are complete: one row for each object in each sweep.

        The fields are id, sweep, points, center (m), size (m), yaw (rad), velocity (m/s), yaw_rate (rad/s) and
        confidence, in the frame of the sweep. None without `track`.
        """
        return self._native.tracks()
