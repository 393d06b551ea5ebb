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
    /// A cloud with a colour for each point.
    Colored(ColoredCloud),
    /// Boxes in the cloud's frame.
    Boxes(Vec<Box3>),
}

/// A cloud with a colour for each point.
#[derive(Clone, Debug, PartialEq)]
pub struct ColoredCloud {
    /// Its points.
    pub cloud: Cloud,
    /// The colour of each point: its number in `palette`.
    pub colors: Vec<u8>,
    /// CSS colours.
    pub palette: Vec<String>,
    /// What stands beside the checkbox of the layer: CSS backgrounds of swatches, each with its text.
    pub legend: Vec<(String, String)>,
}

/// A layer of a scene; it can be hidden.
#[derive(Clone, Debug, PartialEq)]
pub struct Layer {
    /// Name next to its checkbox.
    pub name: String,
    /// CSS colour: `#0072b2`. Empty for a cloud with colours of its own.
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
    /// Layers in place of these while the switch of the view is on.
    pub on: Option<Vec<Layer>>,
    /// Camera target of the "Target" button, m; `None`: the origin.
    pub focus_m: Option<[f64; 3]>,
}

/// Scenes, and the bytes of their points as base64: clouds that are in several scenes are there once.
#[derive(Serialize, Default)]
struct ScenesJson<'a> {
    blobs: Vec<String>,
    scenes: Vec<SceneJson<'a>>,
}

#[derive(Serialize)]
struct SceneJson<'a> {
    name: &'a str,
    focus: Option<[f64; 3]>,
    layers: Vec<LayerJson<'a>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    on: Option<Vec<LayerJson<'a>>>,
}

#[derive(Serialize, Default)]
struct LayerJson<'a> {
    name: &'a str,
    color: &'a str,
    /// Numbers of blobs.
    #[serde(skip_serializing_if = "Option::is_none")]
    points: Option<usize>,
    #[serde(skip_serializing_if = "Option::is_none")]
    colors: Option<usize>,
    #[serde(skip_serializing_if = "Option::is_none")]
    palette: Option<&'a [String]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    legend: Option<&'a [(String, String)]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    boxes: Option<Vec<[f64; 7]>>,
}

/// The scenes as JSON that is safe inside a script element.
pub(crate) fn scenes_json(scenes: &[Scene]) -> String {
    let mut json = ScenesJson::default();
    for scene in scenes {
        let layers = json.layers(&scene.layers);
        let on = scene.on.as_deref().map(|on| json.layers(on));
        let shown = SceneJson { name: &scene.name, focus: scene.focus_m, layers, on };
        json.scenes.push(shown);
    }
    // Escapes `<`, so that no text of a scene can end the script element.
    serde_json::to_string(&json).expect("a scene is plain data").replace('<', "\\u003c")
}

impl<'a> ScenesJson<'a> {
    fn layers(&mut self, layers: &'a [Layer]) -> Vec<LayerJson<'a>> {
        layers.iter().map(|layer| self.layer(layer)).collect()
    }

    fn layer(&mut self, layer: &'a Layer) -> LayerJson<'a> {
        let json = LayerJson { name: &layer.name, color: &layer.color, ..LayerJson::default() };
        match &layer.content {
            LayerContent::Cloud(cloud) => LayerJson { points: Some(self.blob(&centimetres(cloud))), ..json },
            LayerContent::Colored(colored) => {
                let near = colored.cloud.points().zip(&colored.colors).filter(|(point, _)| is_near(point));
                let colors: Vec<u8> = near.map(|(_, color)| *color).collect();
                LayerJson {
                    points: Some(self.blob(&centimetres(&colored.cloud))),
                    colors: Some(self.blob(&colors)),
                    palette: Some(&colored.palette),
                    legend: Some(&colored.legend),
                    ..json
                }
            }
            LayerContent::Boxes(boxes) => {
                let finite = boxes.iter().map(Box3::to_array).filter(|b| b.iter().all(|v| v.is_finite()));
                LayerJson { boxes: Some(finite.map(|b| b.map(|v| (v * 1e4).round() / 1e4)).collect()), ..json }
            }
        }
    }

    /// The number of some bytes.
    fn blob(&mut self, bytes: &[u8]) -> usize {
        let text = BASE64_STANDARD.encode(bytes);
        self.blobs.iter().position(|blob| *blob == text).unwrap_or_else(|| {
            self.blobs.push(text);
            self.blobs.len() - 1
        })
    }
}

/// Whether a point is finite, and near enough to be written in centimetres.
fn is_near(point: &[f32]) -> bool {
    point[..3].iter().all(|v| v.abs() <= FARTHEST_M)
}

/// Positions in centimetres as 16-bit little-endian integers; non-finite or too distant points are skipped.
fn centimetres(cloud: &Cloud) -> Vec<u8> {
    let near = cloud.points().filter(|point| is_near(point)).flat_map(|p| [p[0], p[1], p[2]]);
    near.flat_map(|v| ((v * 100.0).round() as i16).to_le_bytes()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cloud() -> Cloud {
        Cloud { values: vec![1.0, -2.5, 0.014, f32::NAN, 0.0, 0.0, 900.0, 0.0, 0.0, 2.0, 0.0, 0.0], channels: 3 }
    }

    #[test]
    fn positions_are_centimetres_and_text_cannot_leave() {
        assert_eq!(centimetres(&cloud()), [100i16, -250, 1, 200, 0, 0].map(i16::to_le_bytes).concat());
        let boxes = LayerContent::Boxes(vec![Box3::from_array([f64::NAN; 7]), Box3::from_array([1.0; 7])]);
        let labels = Layer { name: "labels".into(), color: "#0072b2".into(), content: boxes };
        let text = scenes_json(&[Scene { name: "</script><b>".into(), layers: vec![labels], ..Scene::default() }]);
        assert!(!text.contains('<') && text.contains("\"boxes\":[[1.0,"), "{text}");
        let parsed: serde_json::Value = serde_json::from_str(&text).unwrap();
        assert_eq!(parsed["scenes"][0]["name"], "</script><b>");
    }

    #[test]
    fn a_point_that_is_skipped_has_no_colour_and_a_cloud_is_written_once() {
        let of_colors = |colors: [u8; 4]| {
            let palette = vec!["#000000".into(), "#ffffff".into()];
            let legend = vec![("#000000".into(), "none".into())];
            let content =
                LayerContent::Colored(ColoredCloud { cloud: cloud(), colors: colors.into(), palette, legend });
            vec![Layer { name: "measured".into(), color: String::new(), content }]
        };
        let scene = |name: &str| Scene {
            layers: of_colors([0, 1, 1, 1]),
            on: Some(of_colors([1; 4])),
            name: name.into(),
            focus_m: None,
        };
        let parsed: serde_json::Value = serde_json::from_str(&scenes_json(&[scene("a"), scene("b")])).unwrap();
        let blob = |number: &serde_json::Value| {
            BASE64_STANDARD.decode(parsed["blobs"][number.as_u64().unwrap() as usize].as_str().unwrap()).unwrap()
        };
        for scene in parsed["scenes"].as_array().unwrap() {
            assert_eq!(blob(&scene["layers"][0]["points"]), centimetres(&cloud()));
            assert_eq!(blob(&scene["layers"][0]["colors"]), [0, 1]);
            assert_eq!(blob(&scene["on"][0]["colors"]), [1, 1]);
        }
        assert_eq!(parsed["blobs"].as_array().unwrap().len(), 3);
    }
}
