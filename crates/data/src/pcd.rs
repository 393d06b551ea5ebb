//! PCD files (Point Cloud Data), version 0.7: ascii, binary and binary_compressed; fields in any order, size and type.
//!
//! x, y, z and, if present, intensity are read; other fields are ignored. Memory use is bounded by the file size: the
//! counts in the header are compared with the number of bytes before memory is allocated.

use crate::cloud_file::check_cloud;
use crate::lzf;
use crate::pcd_header::{PcdEncoding, PcdField, PcdHeader, parse_pcd_header};
use crate::{Cloud, DataError};
use std::path::Path;

/// Largest compression ratio of LZF: three bytes encode at most 264 bytes.
const LZF_MAX_RATIO: u64 = 88;

/// Parses a PCD file. `path` is used in error messages.
///
/// In an organised cloud (HEIGHT above 1) points whose x, y and z are all NaN are rays without a return and are left
/// out. Any other NaN is an error. The checks of [`crate::read_cloud`] apply.
pub fn parse_pcd(bytes: &[u8], path: &Path) -> Result<Cloud, DataError> {
    let header = parse_pcd_header(bytes, path)?;
    let body = &bytes[header.body_start..];
    let columns = header.columns();
    let values = match header.encoding {
        PcdEncoding::Ascii => ascii(body, &header, &columns, path)?,
        PcdEncoding::Binary => binary(body, &header, &columns, path)?,
        PcdEncoding::BinaryCompressed => compressed(body, &header, &columns, path)?,
    };
    let mut cloud = Cloud { values, channels: columns.len() };
    if header.height > 1 {
        cloud.retain(|_, p| !p[..3].iter().all(|v| v.is_nan()));
    }
    check_cloud(&cloud, path)?;
    Ok(cloud)
}

fn ascii(body: &[u8], header: &PcdHeader, columns: &[&PcdField], path: &Path) -> Result<Vec<f32>, DataError> {
    let text = std::str::from_utf8(body)
        .map_err(|_| DataError::file(path, "has DATA ascii, but its points are not UTF-8 text"))?;
    // A point has at least six bytes: the length of the text limits the reserved memory.
    let mut values = Vec::with_capacity(columns.len() * header.points.min(body.len() as u64 / 6 + 1) as usize);
    let (mut points, mut tokens) = (0, Vec::new());
    for (i, line) in text.lines().enumerate() {
        if line.trim_ascii().is_empty() {
            continue;
        }
        let wrong = |message: String| DataError::line(path, header.body_line + i, message);
        tokens.clear();
        tokens.extend(line.split_ascii_whitespace());
        if tokens.len() != header.numbers_per_point {
            return Err(wrong(format!(
                "{} numbers, but FIELDS and COUNT require {}",
                tokens.len(),
                header.numbers_per_point
            )));
        }
        for field in columns {
            let token: &str = tokens[field.first_number];
            let value: f32 = token.parse().map_err(|_| wrong(format!("{} = {token:?} is not a number", field.name)))?;
            values.push(value);
        }
        points += 1;
        if points > header.points {
            return Err(wrong(format!("more points than the {} of the header", header.points)));
        }
    }
    if points < header.points {
        return Err(DataError::file(path, format!("has {points} points, but its header says {}", header.points)));
    }
    Ok(values)
}

fn binary(body: &[u8], header: &PcdHeader, columns: &[&PcdField], path: &Path) -> Result<Vec<f32>, DataError> {
    let wanted = header.body_bytes(path)?;
    if body.len() as u64 != wanted {
        return Err(DataError::file(
            path,
            format!(
                "has {} bytes of points, but its header says {} points of {} bytes",
                body.len(),
                header.points,
                header.point_bytes
            ),
        ));
    }
    let mut values = vec![0.0; columns.len() * header.points as usize];
    for (channel, field) in columns.iter().enumerate() {
        let points = body.chunks_exact(header.point_bytes as usize).map(|point| &point[field.offset..]);
        field.number.read_all(points, values.iter_mut().skip(channel).step_by(columns.len()));
    }
    Ok(values)
}

fn compressed(body: &[u8], header: &PcdHeader, columns: &[&PcdField], path: &Path) -> Result<Vec<f32>, DataError> {
    let wrong = |message: String| DataError::file(path, message);
    let Some((sizes, stream)) = body.split_at_checked(8) else {
        return Err(wrong("ends before the two sizes of the compressed points".into()));
    };
    let size = |at: usize| u64::from(u32::from_le_bytes([sizes[at], sizes[at + 1], sizes[at + 2], sizes[at + 3]]));
    let (packed, unpacked, wanted) = (size(0), size(4), header.body_bytes(path)?);
    if stream.len() as u64 != packed {
        return Err(wrong(format!(
            "has {} bytes of compressed points, but its compressed size is given as {packed}",
            stream.len()
        )));
    }
    if unpacked != wanted {
        return Err(wrong(format!(
            "has an uncompressed size of {unpacked} bytes, but its header says {} points of {} bytes",
            header.points, header.point_bytes
        )));
    }
    if unpacked > packed.saturating_mul(LZF_MAX_RATIO) {
        return Err(wrong(format!(
            "gives {packed} bytes as the compressed size of {unpacked} bytes, which LZF cannot reach"
        )));
    }
    if unpacked == 0 {
        return Ok(Vec::new());
    }
    let bytes = lzf::decompress(stream, unpacked as usize)
        .map_err(|e| wrong(format!("the compressed points cannot be decompressed: {e}")))?;
    // Column-major: all values of the first field, then all values of the second, and so on.
    let points = header.points as usize;
    let mut values = vec![0.0; columns.len() * points];
    for (channel, field) in columns.iter().enumerate() {
        let column = &bytes[field.offset * points..][..field.bytes() * points];
        field
            .number
            .read_all(column.chunks_exact(field.bytes()), values.iter_mut().skip(channel).step_by(columns.len()));
    }
    Ok(values)
}

/// Encodes a cloud as PCD v0.7 with the fields x, y, z and, with four channels, intensity, each an f32.
pub fn encode_pcd(cloud: &Cloud, encoding: PcdEncoding) -> Vec<u8> {
    let (points, channels) = (cloud.len(), cloud.channels);
    let repeat = |text: &str| vec![text; channels].join(" ");
    let fields = ["x", "y", "z", "intensity"][..channels].join(" ");
    let mut out = format!(
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS {fields}\nSIZE {}\nTYPE {}\nCOUNT {}\nWIDTH {points}\nHEIGHT 1\n\
         VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\nDATA {}\n",
        repeat("4"),
        repeat("F"),
        repeat("1"),
        encoding.keyword()
    )
    .into_bytes();
    match encoding {
        PcdEncoding::Ascii => {
            for point in cloud.points() {
                let numbers: Vec<String> = point.iter().map(f32::to_string).collect();
                out.extend_from_slice(numbers.join(" ").as_bytes());
                out.push(b'\n');
            }
        }
        PcdEncoding::Binary => out.extend(cloud.values.iter().flat_map(|v| v.to_le_bytes())),
        PcdEncoding::BinaryCompressed => {
            let column = |c: usize| cloud.values.iter().skip(c).step_by(channels).flat_map(|v| v.to_le_bytes());
            let plain: Vec<u8> = (0..channels).flat_map(column).collect();
            let packed = lzf::compress(&plain);
            out.extend((packed.len() as u32).to_le_bytes());
            out.extend((plain.len() as u32).to_le_bytes());
            out.extend(packed);
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const ENCODINGS: [PcdEncoding; 3] = [PcdEncoding::Ascii, PcdEncoding::Binary, PcdEncoding::BinaryCompressed];

    fn ascii_file(changes: &[(&str, &str)]) -> String {
        let mut text = "# a comment\nVERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH 2\nHEIGHT 1\n\
                        VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 2\nDATA ascii\n1 2 3 0.5\n-4 5 6.5 0.25\n"
            .to_string();
        for (from, to) in changes {
            assert!(text.contains(from), "{from}");
            text = text.replace(from, to);
        }
        text
    }

    fn error_of(bytes: &[u8]) -> String {
        parse_pcd(bytes, Path::new("pcl/12.pcd")).unwrap_err().to_string()
    }

    #[test]
    fn fields_in_any_order_size_and_type() {
        let mut bytes = b"VERSION .7\nFIELDS ring intensity z _ y x\nSIZE 2 1 8 1 4 4\nTYPE U U F U F I\nCOUNT 1 1 1 3 1 1\nWIDTH 2\nHEIGHT 1\n\
            DATA binary\n"
            .to_vec();
        for (ring, intensity, z, y, x) in [(7u16, 255u8, -1.5f64, 2.25f32, -7i32), (8, 3, 0.5, -2.0, 9)] {
            bytes.extend(ring.to_le_bytes());
            bytes.push(intensity);
            bytes.extend(z.to_le_bytes());
            bytes.extend([1, 2, 3]);
            bytes.extend(y.to_le_bytes());
            bytes.extend(x.to_le_bytes());
        }
        let cloud = parse_pcd(&bytes, Path::new("a.pcd")).unwrap();
        assert_eq!(cloud, Cloud { values: vec![-7.0, 2.25, -1.5, 255.0, 9.0, -2.0, 0.5, 3.0], channels: 4 });
    }

    #[test]
    fn bad_files_are_refused_by_name_and_line() {
        let fine = ascii_file(&[]);
        assert_eq!(parse_pcd(fine.as_bytes(), Path::new("a.pcd")).unwrap().values[4..], [-4.0, 5.0, 6.5, 0.25]);
        let cases: &[(&[(&str, &str)], &str)] = &[
            (&[("POINTS 2", "POINTS 3")], "12.pcd:10: POINTS 3 is not WIDTH 2 x HEIGHT 1"),
            (&[("POINTS 2", "POINTS 3"), ("WIDTH 2", "WIDTH 3")], "has 2 points, but its header says 3"),
            (&[("POINTS 2", "POINTS 1"), ("WIDTH 2", "WIDTH 1")], "12.pcd:13: more points than the 1"),
            (&[("FIELDS x y z intensity", "FIELDS x y w intensity")], "12.pcd:3: FIELDS has no z"),
            (&[("FIELDS x y z intensity", "FIELDS x y z x")], "FIELDS has x twice"),
            (&[("DATA ascii", "DATA zip")], "12.pcd:11: DATA \"zip\""),
            (&[("DATA ascii", "DATUM")], "12.pcd:11: \"DATUM\" is not a PCD header entry"),
            (&[("SIZE 4 4 4 4", "SIZE 4 4 4")], "12.pcd:4: SIZE has 3 values, but FIELDS has 4"),
            (&[("SIZE 4 4 4 4\n", "")], "has no SIZE"),
            (&[("TYPE F F F F", "TYPE F F F Q")], "TYPE Q of size 4"),
            (&[("SIZE 4 4 4 4", "SIZE 4 4 4 3")], "TYPE F of size 3"),
            (&[("COUNT 1 1 1 1", "COUNT 2 1 1 1")], "x has COUNT 2"),
            (&[("VERSION 0.7", "VERSION 9")], "VERSION 9"),
            (&[("WIDTH 2", "WIDTH -2")], "12.pcd:7: WIDTH \"-2\""),
            (&[("WIDTH 2\n", "WIDTH 2\nWIDTH 2\n")], "WIDTH occurs twice"),
            (&[("6.5 0.25", "6.5")], "12.pcd:13: 3 numbers"),
            (&[("6.5", "6,5")], "12.pcd:13: z = \"6,5\" is not a number"),
            (&[("6.5", "nan")], "z = NaN"),
            (&[("6.5", "1e30")], "10 km"),
            (&[("POINTS 2", "POINTS 0"), ("WIDTH 2", "WIDTH 0"), ("1 2 3 0.5\n-4 5 6.5 0.25\n", "")], "no point"),
        ];
        for (changes, want) in cases {
            let error = error_of(ascii_file(changes).as_bytes());
            assert!(error.contains("12.pcd") && error.contains(want), "{error}, not {want}");
        }
        assert!(error_of(b"").contains("no DATA line"));
        assert!(error_of(&fine.as_bytes()[..40]).contains("no DATA line"));
    }

    #[test]
    fn huge_counts_take_no_memory() {
        for data in ["ascii", "binary", "binary_compressed"] {
            let header = |count: &str, width: &str| {
                format!(
                    "VERSION .7\nFIELDS x y z a\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 {count}\nWIDTH {width}\nHEIGHT 4294967295\nDATA {data}\n"
                )
            };
            for (count, width) in [
                ("1", "4294967295"),
                ("18446744073709551615", "1"),
                ("1", "18446744073709551615"),
                ("4611686018427387904", "4"),
            ] {
                let error = error_of(header(count, width).as_bytes());
                assert!(error.contains("12.pcd"), "{error}");
            }
        }
    }

    #[test]
    fn wrong_compressed_sizes_are_refused() {
        let cloud = Cloud { values: vec![1.0; 3000], channels: 3 };
        let fine = encode_pcd(&cloud, PcdEncoding::BinaryCompressed);
        assert!(fine.len() < 600, "{}", fine.len());
        let body = fine.windows(7).position(|w| w == b"pressed").unwrap() + 8;
        let with = |at: usize, value: u32| {
            let mut bytes = fine.clone();
            bytes[body + at..body + at + 4].copy_from_slice(&value.to_le_bytes());
            error_of(&bytes)
        };
        assert!(with(0, 5).contains("is given as 5"));
        assert!(with(4, 11_999).contains("uncompressed size of 11999"));
        let text = String::from_utf8_lossy(&fine[..body]).replace("1000", "15000000");
        let mut bomb = text.into_bytes();
        bomb.extend(&fine[body..]);
        let at = bomb.len() - (fine.len() - body) + 4;
        bomb[at..at + 4].copy_from_slice(&180_000_000u32.to_le_bytes());
        assert!(error_of(&bomb).contains("LZF cannot"), "{}", error_of(&bomb));
        assert!(error_of(&fine[..fine.len() - 1]).contains("compressed points"));
        assert!(error_of(&fine[..body + 3]).contains("ends before"));
    }

    #[test]
    fn organised_clouds_may_have_rays_without_return() {
        let organised =
            ascii_file(&[("HEIGHT 1", "HEIGHT 2"), ("WIDTH 2", "WIDTH 1"), ("1 2 3 0.5", "nan nan nan nan")]);
        assert_eq!(parse_pcd(organised.as_bytes(), Path::new("a.pcd")).unwrap().len(), 1);
        let halfway = organised.replace("nan nan nan nan", "nan 1 1 1");
        assert!(error_of(halfway.as_bytes()).contains("x = NaN"));
    }

    proptest! {
        #[test]
        fn pcd_round_trips(channels in 3usize..5, seed in prop::collection::vec(-9_999.0f32..9_999.0, 4..400), repeat in 1usize..5) {
            let mut values = seed.repeat(repeat);
            values.truncate(values.len() / channels * channels);
            let cloud = Cloud { values, channels };
            for encoding in ENCODINGS {
                let bytes = encode_pcd(&cloud, encoding);
                prop_assert_eq!(&parse_pcd(&bytes, Path::new("a.pcd")).unwrap(), &cloud);
            }
        }

        #[test]
        fn damaged_files_do_not_panic(at in 0usize..1000, byte in any::<u8>(), cut in 0usize..1000, encoding in 0usize..3) {
            let cloud = Cloud { values: (0..120).map(|i| i as f32).collect(), channels: 4 };
            let mut bytes = encode_pcd(&cloud, ENCODINGS[encoding]);
            let (at, cut) = (at % bytes.len(), cut % bytes.len());
            bytes[at] = byte;
            let _ = parse_pcd(&bytes, Path::new("a.pcd"));
            let _ = parse_pcd(&bytes[..cut], Path::new("a.pcd"));
        }
    }
}
