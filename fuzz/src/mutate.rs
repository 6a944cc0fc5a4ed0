//! Damage as disks, transfers, editors and the ill-willed do it.

use rand::RngExt;
use rand_chacha::ChaCha8Rng;

/// Longest file that is tried.
const LONGEST: usize = 64 * 1024;

/// Numbers that readers stumble over, in text.
const WORDS: &[&[u8]] = &[
    b"-1",
    b"0",
    b"1e308",
    b"1e-320",
    b"-1e999",
    b"nan",
    b"inf",
    b"4294967295",
    b"4294967296",
    b"18446744073709551615",
    b"-9223372036854775808",
    b"65536",
    b"",
    b"\n",
    b"\"",
    b"[",
    b"{",
    b"&a *a",
];

/// A damaged copy of `file`; parts of `other` may get into it.
pub fn mutate(file: &[u8], other: &[u8], dice: &mut ChaCha8Rng) -> Vec<u8> {
    let mut bytes = file.to_vec();
    for _ in 0..dice.random_range(1..=4) {
        once(&mut bytes, other, dice);
    }
    bytes.truncate(LONGEST);
    bytes
}

fn once(bytes: &mut Vec<u8>, other: &[u8], dice: &mut ChaCha8Rng) {
    if bytes.is_empty() {
        bytes.push(dice.random());
        return;
    }
    // Headers come first and decide most.
    let near = if dice.random_bool(0.5) {
        256
    } else {
        usize::MAX
    };
    let at = dice.random_range(0..bytes.len().min(near));
    let end = (at + dice.random_range(1..=64)).min(bytes.len());
    match dice.random_range(0..10) {
        0 => bytes[at] ^= 1 << dice.random_range(0..8),
        1 => bytes[at] = dice.random(),
        2 => bytes.truncate(at),
        3 => drop(bytes.drain(at..end)),
        4 => {
            let copy = bytes[at..end].to_vec();
            drop(bytes.splice(at..at, copy));
        }
        5 => {
            // A number of 1, 2, 4 or 8 bytes becomes an extreme one.
            let width = 1usize << dice.random_range(0..4);
            let extreme = [0, 1, u64::MAX, u64::MAX >> 1, 1 << 31, 1 << 16, 1 << 40];
            let value = extreme[dice.random_range(0..extreme.len())];
            let value = match dice.random_bool(0.5) {
                true => value.to_le_bytes()[..width].to_vec(),
                false => value.to_be_bytes()[8 - width..].to_vec(),
            };
            let end = (at + width).min(bytes.len());
            bytes[at..end].copy_from_slice(&value[..end - at]);
        }
        6 => {
            // A number in text becomes another.
            let digits = |b: &u8| b.is_ascii_digit() || b".-+eE".contains(b);
            let start = at + bytes[at..].iter().position(digits).unwrap_or(0);
            let length = bytes[start..].iter().take_while(|b| digits(b)).count();
            let word = WORDS[dice.random_range(0..WORDS.len())];
            drop(bytes.splice(start..start + length, word.iter().copied()));
        }
        7 => {
            let lines: Vec<&[u8]> = bytes.split(|b| *b == b'\n').collect();
            let k = dice.random_range(0..lines.len());
            let mut kept = lines.clone();
            match dice.random_bool(0.5) {
                true => drop(kept.remove(k)),
                false => kept.insert(k, lines[dice.random_range(0..lines.len())]),
            }
            *bytes = kept.join(&b'\n');
        }
        8 if !other.is_empty() => {
            let from = dice.random_range(0..other.len());
            let to = (from + dice.random_range(1..=512)).min(other.len());
            drop(bytes.splice(at..end, other[from..to].iter().copied()));
        }
        _ => {
            bytes[at] = bytes[at]
                .wrapping_add(dice.random_range(0..=16))
                .wrapping_sub(8)
        }
    }
}
