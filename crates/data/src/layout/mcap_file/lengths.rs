//! Lengths inside of records, compared with the records before the crate `mcap` reads them: it allocates what a length
//! claims, up to 4 GiB.

use ::mcap::records::op;
use Item::{Bytes, Numbers, Text, Texts};

/// A part of a record.
enum Item {
    /// So many bytes.
    Bytes(usize),
    /// A length (u32) and a text.
    Text,
    /// A length in bytes (u32), and as many pairs of texts.
    Texts,
    /// A length in bytes (u32), and as many pairs of u16 and u64.
    Numbers,
}

/// The parts of a record up to its last text.
fn items(opcode: u8) -> &'static [Item] {
    match opcode {
        op::HEADER => &[Text, Text],
        op::SCHEMA => &[Bytes(2), Text, Text],
        op::CHANNEL => &[Bytes(4), Text, Text, Texts],
        op::CHUNK => &[Bytes(28), Text],
        op::CHUNK_INDEX => &[Bytes(32), Numbers, Bytes(8), Text],
        op::ATTACHMENT => &[Bytes(16), Text, Text],
        op::ATTACHMENT_INDEX => &[Bytes(40), Text, Text],
        op::METADATA => &[Text, Texts],
        op::METADATA_INDEX => &[Bytes(16), Text],
        _ => &[],
    }
}

/// Whether all texts of a record end within it.
pub(super) fn fit(opcode: u8, body: &[u8]) -> bool {
    let mut rest = body;
    items(opcode).iter().all(|item| skip(&mut rest, item).is_some())
}

fn skip(rest: &mut &[u8], item: &Item) -> Option<()> {
    match item {
        Bytes(count) => *rest = rest.get(*count..)?,
        Text => {
            let length = length(rest)?;
            *rest = rest.get(length..)?;
        }
        Texts => {
            let end = length(rest)?;
            let whole = rest.len();
            while whole - rest.len() < end {
                skip(rest, &Text)?;
                skip(rest, &Text)?;
            }
        }
        Numbers => {
            let pairs = length(rest)?.div_ceil(size_of::<u16>() + size_of::<u64>());
            *rest = rest.get(pairs * (size_of::<u16>() + size_of::<u64>())..)?;
        }
    }
    Some(())
}

fn length(rest: &mut &[u8]) -> Option<usize> {
    let (length, behind) = rest.split_first_chunk::<4>()?;
    *rest = behind;
    usize::try_from(u32::from_le_bytes(*length)).ok()
}

/// Checks the records of a summary, from its start to the end of the file.
///
/// # Errors
/// A record or a text that is longer than what is left for it, and a chunk, which a summary does not have.
pub(super) fn check_summary(mut bytes: &[u8]) -> Result<(), &'static str> {
    while let Some((head, behind)) = bytes.split_first_chunk::<9>().filter(|(head, _)| head[0] != op::FOOTER) {
        let [opcode, length @ ..] = head;
        let length = usize::try_from(u64::from_le_bytes(*length)).unwrap_or(usize::MAX);
        let (body, next) = behind.split_at_checked(length).ok_or("a record of its summary is longer than the file")?;
        if *opcode == op::CHUNK || !fit(*opcode, body) {
            return Err("a record of its summary is damaged");
        }
        bytes = next;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn text(text: &str) -> Vec<u8> {
        [&(text.len() as u32).to_le_bytes(), text.as_bytes()].concat()
    }

    #[test]
    fn texts_end_within_their_record() {
        let pair = [text("key"), text("value")].concat();
        let pairs = [(pair.len() as u32).to_le_bytes().to_vec(), pair].concat();
        let offsets = [&20u32.to_le_bytes()[..], &[0; 20]].concat();
        for (opcode, body) in [
            (op::HEADER, [text("ros2"), text("")].concat()),
            (op::SCHEMA, [vec![0; 2], text("a/msg/B"), text("ros2msg")].concat()),
            (op::CHANNEL, [vec![0; 4], text("/points"), text("cdr"), pairs.clone()].concat()),
            (op::CHUNK, [vec![0; 28], text("zstd")].concat()),
            (op::CHUNK_INDEX, [vec![0; 32], offsets, vec![0; 8], text("lz4")].concat()),
            (op::ATTACHMENT, [vec![0; 16], text("a"), text("b")].concat()),
            (op::ATTACHMENT_INDEX, [vec![0; 40], text("a"), text("b")].concat()),
            (op::METADATA, [text("a"), pairs].concat()),
            (op::METADATA_INDEX, [vec![0; 16], text("a")].concat()),
        ] {
            assert!(fit(opcode, &body), "{opcode}");
            assert!(fit(opcode, &[&body[..], b"more"].concat()), "{opcode}");
            assert!((0..body.len()).all(|length| !fit(opcode, &body[..length])), "{opcode}");
        }
        assert!(fit(op::MESSAGE, b""));
    }

    #[test]
    fn records_of_a_summary_end_within_it() {
        let record = |opcode: u8, length: u64, body: &[u8]| [&[opcode][..], &length.to_le_bytes(), body].concat();
        let header = [text("a"), text("b")].concat();
        let good = record(op::HEADER, 10, &header);
        let footer = record(op::FOOTER, u64::MAX, &[]);
        assert_eq!(check_summary(&[good.clone(), good.clone(), footer].concat()), Ok(()));
        assert_eq!(check_summary(&[&good[..], b"short"].concat()), Ok(()));
        for length in [11, u64::MAX] {
            let error = check_summary(&record(op::HEADER, length, &header)).unwrap_err();
            assert_eq!(error, "a record of its summary is longer than the file");
        }
        for bad in [record(op::HEADER, 9, &header), record(op::CHUNK, 10, &header)] {
            assert_eq!(check_summary(&[good.clone(), bad].concat()), Err("a record of its summary is damaged"));
        }
    }
}
