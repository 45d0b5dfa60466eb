"""Linear algebra that keeps to the thread that asks for it."""

from threading import Barrier, Thread

from threadpoolctl import threadpool_info

from mrbokeh.workers import one_blas_thread


def blas_threads() -> set[int]:
    return {each["num_threads"] for each in threadpool_info() if each["user_api"] == "blas"}


def test_one_thread_until_the_last_one_leaves_whoever_came_first() -> None:
    before, seen = blas_threads(), []
    inside, first_has_left = Barrier(2), Barrier(2)

    def first() -> None:
        with one_blas_thread():
            inside.wait()
        first_has_left.wait()

    def second() -> None:
        with one_blas_thread():
            inside.wait()
            first_has_left.wait()
            seen.append(blas_threads())

    threads = [Thread(target=each) for each in (first, second)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert before and seen == [{1}] and blas_threads() == before
