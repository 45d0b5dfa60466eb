"""Run `tests.bench.bench_real`: real focus stacks beside the peers."""

from tests.bench.bench_real import main

if __name__ == "__main__":
    main()
