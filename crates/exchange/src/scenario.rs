//! What has to be changed in a scenario, its assets or its labels for effects that no sensor model contains.

use sensor::Effect;

/// Whether an effect acts on the labels.
pub(crate) fn of_labels(effect: &Effect) -> bool {
    matches!(effect, Effect::LabelNoise(_) | Effect::LabelOffset(_) | Effect::LabelTimeOffset(_))
}

/// What to change for an effect.
pub(crate) fn change(effect: &Effect) -> &'static str {
    match effect {
        Effect::LabelOffset(_) => "move the boxes that the scenario writes as labels, in the frame of each object",
        Effect::LabelNoise(_) => "add the errors to the boxes that the scenario writes as labels",
        Effect::LabelTimeOffset(_) => "write the boxes of another moment than that of the cloud",
        Effect::TargetAttitude(_) => "give the other cars the roll and pitch of their suspension",
        Effect::GroundError(_) => "add the undulation to the mesh of the ground",
        Effect::MissingObjects(_) => "remove these groups of objects from the scene",
        Effect::ExtraObjects(_) => "put these groups of objects into the scene",
        Effect::TargetShape(_) => "scale the meshes of the other cars",
        Effect::Ghosts(_) => "give mirrors and windows a specular material, if the program follows reflected rays",
        Effect::Blooming(_) => "none of the programs models halos; leave them out or draw them around bright targets",
        Effect::DualReturns(_) => "ask the sensor for two returns per shot",
        Effect::MountVibration(_) => "move the mount of the sensors in the scenario",
        _ => "needs new rays with another geometry: change the scenario",
    }
}
