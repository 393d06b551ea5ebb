//! Clouds and boxes for the interactive 3D view.

use base64::{Engine as _, prelude::BASE64_STANDARD};
use data::Cloud;
use geometry::Box3;
use serde::Serialize;

/// Largest coordinate that fits into centimetres as 16-bit integers, m.
const FARTHEST_M: f32 = 327.0;

/// Content of a layer.
#[derive(Clone, Debug, PartialEq)]
pub enum LayerContent {
    /// A cloud.
    Cloud(Cloud),
    /// Boxes in the cloud's frame.
    Boxes(Vec<Box3>),
}

/// A layer of a scene, with one colour; it can be hidden.
#[derive(Clone, Debug, PartialEq)]
pub struct Layer {
    /// Name next to its checkbox.
    pub name: String,
    /// CSS colour: `#0072b2`.
    pub color: String,
    /// Clouds or boxes.
    pub content: LayerContent,
}

/// One frame: measured and simulated clouds, labels, detections.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct Scene {
    /// Name in the list of frames.
    pub name: String,
    /// Layers in drawing order.
    pub layers: Vec<Layer>,
    /// Camera target of the "Target" button, m; `None`: the origin.
    pub focus_m: Option<[f64; 3]>,
}

#[derive(Serialize)]
struct SceneJson<'a> {
    name: &'a str,
    focus: Option<[f64; 3]>,
    layers: Vec<LayerJson<'a>>,
}

#[derive(Serialize)]
struct LayerJson<'a> {
    name: &'a str,
    color: &'a str,
    #[serde(skip_serializing_if = "Option::is_none")]
    points: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    boxes: Option<Vec<[f64; 7]>>,
}

/// The scenes as JSON that is safe inside a script element.
pub(crate) fn scenes_json(scenes: &[Scene]) -> String {
    let layer = |layer: &'_ Layer| -> (Option<String>, Option<Vec<[f64; 7]>>) {
        match &layer.content {
            LayerContent::Cloud(cloud) => (Some(centimetres(cloud)), None),
            LayerContent::Boxes(boxes) => {
                let finite = boxes.iter().map(Box3::to_array).filter(|b| b.iter().all(|v| v.is_finite()));
                (None, Some(finite.map(|b| b.map(|v| (v * 1e4).round() / 1e4)).collect()))
            }
        }
    };
    let scenes: Vec<SceneJson> = scenes
        .iter()
        .map(|scene| SceneJson {
            name: &scene.name,
            focus: scene.focus_m,
            layers: scene
                .layers
                .iter()
                .map(|l| {
                    let (points, boxes) = layer(l);
                    LayerJson { name: &l.name, color: &l.color, points, boxes }
                })
                .collect(),
        })
        .collect();
    // Escapes `<`, so that no text of a scene can end the script element.
    serde_json::to_string(&scenes).expect("a scene is plain data").replace('<', "\\u003c")
}

/// Positions in centimetres as 16-bit little-endian integers; non-finite or too distant points are skipped.
fn centimetres(cloud: &Cloud) -> String {
    let near = |p: &&[f32]| p[..3].iter().all(|v| v.abs() <= FARTHEST_M);
    let bytes: Vec<u8> = cloud
        .points()
        .filter(near)
        .flat_map(|p| [p[0], p[1], p[2]])
        .flat_map(|v| ((v * 100.0).round() as i16).to_le_bytes())
        .collect();
    BASE64_STANDARD.encode(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn positions_are_centimetres_and_text_cannot_leave() {
        let cloud = Cloud { values: vec![1.0, -2.5, 0.014, f32::NAN, 0.0, 0.0, 900.0, 0.0, 0.0], channels: 3 };
        let bytes = BASE64_STANDARD.decode(centimetres(&cloud)).unwrap();
        assert_eq!(bytes, [100i16, -250, 1].map(i16::to_le_bytes).concat());
        let boxes = LayerContent::Boxes(vec![Box3::from_array([f64::NAN; 7]), Box3::from_array([1.0; 7])]);
        let scene = Scene {
            name: "</script><b>".into(),
            layers: vec![Layer { name: "labels".into(), color: "#0072b2".into(), content: boxes }],
            focus_m: None,
        };
        let text = scenes_json(&[scene]);
        assert!(!text.contains('<') && text.contains("\"boxes\":[[1.0,"), "{text}");
        let parsed: serde_json::Value = serde_json::from_str(&text).unwrap();
        assert_eq!(parsed[0]["name"], "</script><b>");
    }
}
