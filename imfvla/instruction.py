"""Sentences to word ids, by hashing: any sentence works, no vocabulary file, the same ids everywhere."""

import re
import zlib

import numpy as np

MAX_WORDS = 16
NUM_WORD_IDS = 512  # id 0 is padding; 1 ... NUM_WORD_IDS - 1 are words


def tokenize(text: str) -> np.ndarray:
    """Word ids of a sentence: int64 (MAX_WORDS,), case and punctuation ignored, cut or padded with 0 to MAX_WORDS."""
    words = re.findall(r"[a-z0-9]+", text.lower())[:MAX_WORDS]
    ids = np.zeros(MAX_WORDS, dtype=np.int64)
    ids[: len(words)] = [1 + zlib.crc32(word.encode()) % (NUM_WORD_IDS - 1) for word in words]
    return ids
