"""Trains on the example: ``python examples/unicycle/train.py [SEED]``; see README.md."""

import sys

import safemr


def main(seed: int = 0, steps: int = 200_000) -> None:
    record = safemr.train(
        "unicycle_discs:UnicycleDiscs-v1",
        "safemr",
        steps=steps,
        seed=seed,
        log_points=10,
        eval_episodes=20,
        interface={"action_repeat": 2},  # a decision every 0.2 s
        update_every=2,  # learn much from few steps, which cost more here than learning
        multiplier_bias=0.0,  # heed the constraint from the start
        multiplier_lr=3e-3,
    )
    end = record.rows[-1]
    print(
        f"return {end['eval_return']:.2f}, violating steps {end['eval_violation_rate']:.2%}, "
        f"{record.provenance['cpu_s'] / 60:.1f} core-minutes: {record.folder}"
    )


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
