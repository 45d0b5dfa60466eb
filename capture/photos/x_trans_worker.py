"""The process that capture.photos.x_trans starts: an order on standard input, the decoded photograph into a file."""

import pickle
import sys

from capture.photos.decoded_photo import DecodedPhoto
from capture.photos.raw import decode_raw
from mrbokeh.system.errors import InputError


def main() -> None:
    path, white_balance, half_size, result = pickle.load(sys.stdin.buffer)
    try:
        answer: DecodedPhoto | InputError = decode_raw(path, white_balance, half_size=half_size)
    except InputError as error:
        answer = error
    with open(result, "wb") as file:
        pickle.dump(answer, file, protocol=pickle.HIGHEST_PROTOCOL)


if __name__ == "__main__":
    main()
