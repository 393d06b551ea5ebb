//! `tracklet_labels.xml` of KITTI raw: boxes with tracks, in the LiDAR frame, on their lower face.

use super::TrackedObject;
use super::pose_text::check_box;
use crate::DataError;
use crate::limits::{MOST_BOXES, MOST_IDS, at_most, read_text};
use geometry::Box3;
use roxmltree::{Document, Node, ParsingOptions};
use std::collections::BTreeMap;
use std::path::Path;

/// Reads the boxes of each frame number. The name of a track is its place in the file, from 0.
pub(super) fn read_tracklets(path: &Path) -> Result<BTreeMap<usize, Vec<TrackedObject>>, DataError> {
    parse_tracklets(&read_text(path)?, path)
}

fn parse_tracklets(text: &str, path: &Path) -> Result<BTreeMap<usize, Vec<TrackedObject>>, DataError> {
    let options = ParsingOptions { allow_dtd: true, ..ParsingOptions::default() };
    let document = Document::parse_with_options(text, options)
        .map_err(|e| DataError::line(path, e.pos().row as usize, e.to_string()))?;
    let line = |node: Node| document.text_pos_at(node.range().start).row as usize;
    let tracklets = document.descendants().find(|node| node.has_tag_name("tracklets"));
    let tracklets = tracklets.ok_or_else(|| DataError::file(path, "has no element <tracklets>"))?;
    let mut frames: BTreeMap<usize, Vec<TrackedObject>> = BTreeMap::new();
    for (track, item) in items(tracklets).enumerate() {
        let wrong = |node: Node, message: String| DataError::line(path, line(node), message);
        let text_of = |node: Node, name: &str| match node.children().find(|child| child.has_tag_name(name)) {
            Some(child) => Ok(child.text().unwrap_or_default().trim().to_string()),
            None => Err(wrong(node, format!("has no element <{name}>"))),
        };
        let number = |node: Node, name: &str| {
            let text = text_of(node, name)?;
            text.parse::<f64>().map_err(|_| wrong(node, format!("<{name}> is {text:?}, not a number")))
        };
        let class = text_of(item, "objectType")?.replace(char::is_whitespace, "_");
        let [l, w, h] = [number(item, "l")?, number(item, "w")?, number(item, "h")?];
        let first = number(item, "first_frame")?;
        if !(0.0..MOST_IDS as f64).contains(&first) {
            return Err(wrong(item, format!("<first_frame> is {first}, not the number of a frame")));
        }
        let poses = item.children().find(|child| child.has_tag_name("poses"));
        let poses = poses.ok_or_else(|| wrong(item, "has no element <poses>".into()))?;
        for (i, pose) in items(poses).enumerate() {
            let [x, y, z] = [number(pose, "tx")?, number(pose, "ty")?, number(pose, "tz")?];
            let bbox = Box3::from_array([x, y, z + h / 2.0, l, w, h, number(pose, "rz")?]);
            check_box(&bbox).map_err(|message| wrong(pose, message))?;
            let objects = frames.entry(first as usize + i).or_default();
            at_most(path, "boxes of a frame", objects.len() as u64 + 1, MOST_BOXES)?;
            let (track, class) = (track.to_string(), class.clone());
            objects.push(TrackedObject { track, class, bbox: bbox.with_wrapped_yaw() });
        }
    }
    Ok(frames)
}

fn items<'a, 'input>(node: Node<'a, 'input>) -> impl Iterator<Item = Node<'a, 'input>> {
    node.children().filter(|child| child.has_tag_name("item"))
}

/// A made text with a person in the frames 3 and 4.
#[cfg(test)]
pub(super) const MADE_UP: &str = "<?xml version=\"1.0\"?>
<!DOCTYPE boost_serialization>
<boost_serialization><tracklets><count>1</count>
<item><objectType>Person (sitting)</objectType><h>1.5</h><w>1.7</w><l>4</l><first_frame>3</first_frame>
<poses><count>2</count>
<item><tx>10</tx><ty>2</ty><tz>-1.7</tz><rx>0</rx><ry>0</ry><rz>3.5</rz></item>
<item><tx>9</tx><ty>2</ty><tz>-1.7</tz><rx>0</rx><ry>0</ry><rz>0.5</rz></item>
</poses></item></tracklets></boost_serialization>";

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<BTreeMap<usize, Vec<TrackedObject>>, String> {
        parse_tracklets(text, Path::new("tracklet_labels.xml")).map_err(|e| e.to_string())
    }

    #[test]
    fn tracklets_are_boxes_of_frames() {
        let frames = parse(MADE_UP).unwrap();
        assert_eq!(frames.keys().copied().collect::<Vec<_>>(), [3, 4]);
        let object = &frames[&3][0];
        assert_eq!((object.track.as_str(), object.class.as_str()), ("0", "Person_(sitting)"));
        assert_eq!((object.bbox.center, object.bbox.size), ([10.0, 2.0, -0.95], [4.0, 1.7, 1.5]));
        assert!((object.bbox.yaw_rad - (3.5 - std::f64::consts::TAU)).abs() < 1e-12);
        for (from, to, want) in [
            ("<tx>9</tx>", "<tx>far</tx>", "xml:7: <tx> is \"far\", not a number"),
            ("<tx>9</tx>", "", "xml:7: has no element <tx>"),
            ("<tx>9</tx>", "<tx>1e9</tx>", "xml:7: the centre of the box"),
            ("<h>1.5</h>", "<h>0</h>", "xml:6: the sizes of a box must be positive"),
            ("<first_frame>3", "<first_frame>-3", "xml:4: <first_frame> is -3"),
            ("</poses>", "", "xml:"),
            ("tracklets>", "tracks>", "has no element <tracklets>"),
        ] {
            let error = parse(&MADE_UP.replace(from, to)).unwrap_err();
            assert!(error.contains(want), "{error}, not {want}");
        }
    }

    #[test]
    fn real_tracklets_are_the_boxes_of_their_table() {
        let root = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/data/kitti_raw_0001"));
        if !root.exists() {
            return eprintln!("skipped: {} is not there", root.display());
        }
        let frames = read_tracklets(&root.join("tracklet_labels.xml")).unwrap();
        let ids: Vec<String> = (0..36).map(|i| format!("{i:06}")).collect();
        let moments = crate::Dataset::open(root).unwrap().moments(&ids).unwrap();
        let mut compared = 0;
        for (i, moment) in moments.iter().enumerate() {
            let found = frames.get(&i).map_or(&[][..], |objects| objects);
            assert_eq!(found.len(), moment.objects.len(), "frame {i}");
            for want in &moment.objects {
                let got = found.iter().find(|object| object.track == want.track).unwrap();
                assert_eq!(got.class, want.class);
                let off = got.bbox.to_array().into_iter().zip(want.bbox.to_array()).map(|(a, b)| (a - b).abs());
                assert!(off.fold(0.0, f64::max) < 1e-4, "{got:?} {want:?}");
                compared += 1;
            }
        }
        assert!(compared > 50);
    }
}
