"""Parts of `python -m tests.bench.bench_device`: each module measures one thing on a device of torch."""
