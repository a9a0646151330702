"""One worker process, on a machine of which another program hands out the jobs."""

from typing import Any

from hipsta_bids.participant.pool import STARTS, Slot, WorkerLost, WorkerPlan, poll, start


class Worker:
    """One worker process, for callers that hand out jobs themselves; replaced when it dies."""

    def __init__(self, plan: WorkerPlan) -> None:
        self.plan = plan
        self._slot: Slot | None = None

    def __call__(self, job: Any) -> Any:  # noqa: ANN401  (jobs are the caller's)
        """Do one job."""
        slot = self._ready()
        slot.give(job)
        answer = self._listen(slot)
        slot.job = None
        return answer

    def kill(self) -> None:
        """End the process, whatever it is doing; may be called by another thread."""
        slot = self._slot
        if slot is not None and slot.job is None:
            slot.kill()
        elif slot is not None:
            slot.kill_group()  # the thread that waits for the answer does the rest

    def _ready(self) -> Slot:
        for _ in range(STARTS):
            if self._slot is not None and not self._slot.process.is_alive():
                self._slot.kill()
                self._slot = None
            slot = self._slot = self._slot or start(self.plan)
            if slot.ready or not isinstance(self._listen(slot), WorkerLost):
                slot.ready = True
                return slot
        raise RuntimeError(f"worker processes do not start; see {self.plan.log}")

    def _listen(self, slot: Slot) -> Any:  # noqa: ANN401  (jobs are the caller's)
        events: list[tuple[Slot, Any]] = []
        while not events:
            events = poll([slot], self.plan.timeout)
        ((_, message),) = events
        if isinstance(message, WorkerLost):
            self._slot = None
        return message
