//! LZF, the compression of PCD files.
//!
//! A stream is a sequence of runs. A control byte below 32 is followed by as many literal bytes as it says, and one.
//! Any other has a length in its upper three bits (7: the next byte is added) and, with the byte behind, a distance to
//! bytes that were written before; it copies two bytes more than the length. Source: `lzf_d.c` of liblzf.

/// Farthest copy.
const MAX_DISTANCE: usize = 1 << 13;

/// Longest copy.
const MAX_LENGTH: usize = 264;

/// Decompresses a stream that must give exactly `length` bytes.
///
/// # Errors
/// What is wrong with the stream: it ends within a run, copies bytes from before its beginning, or gives another number
/// of bytes. No more than `length` bytes are ever written.
pub(crate) fn decompress(stream: &[u8], length: usize) -> Result<Vec<u8>, String> {
    let mut out = Vec::with_capacity(length);
    let mut rest = stream;
    let cut = || "the stream ends within a run".to_string();
    let next = |rest: &mut &[u8]| {
        let (byte, behind) = rest.split_first()?;
        *rest = behind;
        Some(usize::from(*byte))
    };
    while let Some(control) = next(&mut rest) {
        let room = length - out.len();
        if control < 32 {
            let run = control + 1;
            if run > room {
                return Err(format!("the stream gives more than {length} bytes"));
            }
            let (literals, behind) = rest.split_at_checked(run).ok_or_else(cut)?;
            out.extend_from_slice(literals);
            rest = behind;
            continue;
        }
        let mut run = (control >> 5) + 2;
        if run == 9 {
            run += next(&mut rest).ok_or_else(cut)?;
        }
        let distance = ((control & 31) << 8 | next(&mut rest).ok_or_else(cut)?) + 1;
        if run > room {
            return Err(format!("the stream gives more than {length} bytes"));
        }
        let Some(from) = out.len().checked_sub(distance) else {
            return Err(format!("the stream copies from {distance} bytes back, where only {} stand", out.len()));
        };
        // Source and target may overlap: the copy repeats what it has just written.
        for at in from..from + run {
            out.push(out[at]);
        }
    }
    if out.len() != length {
        return Err(format!("the stream gives {} bytes instead of {length}", out.len()));
    }
    Ok(out)
}

/// Compresses. Data that cannot be compressed grow by 1/32.
pub(crate) fn compress(plain: &[u8]) -> Vec<u8> {
    let mut out = Vec::with_capacity(plain.len() / 2);
    let mut last_seen = vec![usize::MAX; 1 << 14];
    let literals = |out: &mut Vec<u8>, run: &[u8]| {
        for part in run.chunks(32) {
            out.push(part.len() as u8 - 1);
            out.extend_from_slice(part);
        }
    };
    let (mut at, mut run_start) = (0, 0);
    while at + 3 <= plain.len() {
        let key = u32::from_le_bytes([plain[at], plain[at + 1], plain[at + 2], 0]);
        let slot = &mut last_seen[(key.wrapping_mul(0x9E37_79B1) >> 18) as usize];
        let from = std::mem::replace(slot, at);
        if from == usize::MAX || at - from > MAX_DISTANCE || plain[from..from + 3] != plain[at..at + 3] {
            at += 1;
            continue;
        }
        let longest = MAX_LENGTH.min(plain.len() - at);
        let length = (3..longest).find(|k| plain[from + k] != plain[at + k]).unwrap_or(longest);
        literals(&mut out, &plain[run_start..at]);
        let (distance, extra) = (at - from - 1, length - 2);
        let high = (distance >> 8) as u8;
        if extra < 7 {
            out.push((extra as u8) << 5 | high);
        } else {
            out.extend([7 << 5 | high, (extra - 7) as u8]);
        }
        out.push(distance as u8);
        at += length;
        run_start = at;
    }
    literals(&mut out, &plain[run_start..]);
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn streams_by_hand() {
        for (stream, want) in [
            (&[][..], &b""[..]),
            (&[2, b'a', b'b', b'c'], b"abc"),
            // Three literals, then 3 bytes from 3 back.
            (&[2, b'a', b'b', b'c', 1 << 5, 2], b"abcabc"),
            // One literal, repeated 9 + 2 times by a copy that overlaps itself.
            (&[0, b'x', 7 << 5, 2, 0], b"xxxxxxxxxxxx"),
        ] {
            assert_eq!(decompress(stream, want.len()).unwrap(), want, "{stream:?}");
        }
    }

    #[test]
    fn malformed_streams_are_errors() {
        for (stream, length, want) in [
            (&[2, b'a'][..], 3, "ends within a run"),
            (&[0, b'a', 1 << 5], 4, "ends within a run"),
            (&[0, b'a', 7 << 5], 12, "ends within a run"),
            (&[0, b'a', 1 << 5, 1], 4, "copies from 2 bytes back, where only 1 stand"),
            (&[1 << 5, 0], 3, "copies from 1 bytes back, where only 0 stand"),
            (&[2, b'a', b'b', b'c'], 2, "more than 2 bytes"),
            (&[0, b'a', 1 << 5, 0], 3, "more than 3 bytes"),
            (&[0, b'a'], 2, "gives 1 bytes instead of 2"),
            (&[], 1, "gives 0 bytes instead of 1"),
        ] {
            let error = decompress(stream, length).unwrap_err();
            assert!(error.contains(want), "{stream:?}: {error}");
        }
    }

    proptest! {
        #[test]
        fn what_is_compressed_is_decompressed(plain in bytes()) {
            let packed = compress(&plain);
            prop_assert!(packed.len() <= plain.len() + plain.len() / 32 + 1);
            prop_assert_eq!(decompress(&packed, plain.len()).unwrap(), plain);
        }

        #[test]
        fn any_stream_gives_its_length_or_an_error(
            stream in prop::collection::vec(any::<u8>(), 0..200), length in 0usize..2000,
        ) {
            if let Ok(out) = decompress(&stream, length) {
                prop_assert_eq!(out.len(), length);
            }
        }

        #[test]
        fn damaged_streams_do_no_harm(plain in bytes(), at in any::<prop::sample::Index>(), byte in any::<u8>()) {
            let mut packed = compress(&plain);
            prop_assume!(!packed.is_empty());
            let at = at.index(packed.len());
            packed[at] = byte;
            if let Ok(out) = decompress(&packed, plain.len()) {
                prop_assert_eq!(out.len(), plain.len());
            }
            prop_assert!(decompress(&packed[..at], plain.len()).is_err() || plain.is_empty() || at == packed.len());
        }
    }

    /// Random bytes of a small and of a large alphabet, repeated.
    fn bytes() -> impl Strategy<Value = Vec<u8>> {
        let part = prop_oneof![prop::collection::vec(0u8..3, 0..300), prop::collection::vec(any::<u8>(), 0..300)];
        (part, 1usize..40).prop_map(|(part, times)| part.repeat(times))
    }
}
