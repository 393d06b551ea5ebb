//! The configurations that come with the program: each TOML file of `detectors`, `sensors`, `simulate` and `studies`,
//! with its text. The folder is a package so that the crates which build its files in can be published.

/// Path below this folder, with `/`, and text of each file, by path.
pub const FILES: &[(&str, &str)] = &include!(concat!(env!("OUT_DIR"), "/files.rs"));

/// The text of the file at a path below this folder, such as `simulate/race.toml`; `None` if there is none.
pub fn text(path: &str) -> Option<&'static str> {
    FILES.iter().find(|(name, _)| *name == path).map(|(_, text)| *text)
}

/// The names of a folder, without `.toml`, by name.
pub fn names(folder: &str) -> impl Iterator<Item = &'static str> {
    FILES.iter().filter_map(move |(path, _)| path.strip_prefix(folder)?.strip_prefix('/')?.strip_suffix(".toml"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_are_found_by_path_and_by_folder() {
        assert!(text("simulate/race.toml").unwrap().contains("name = \"race\""));
        assert_eq!(text("simulate/race"), None);
        let studies: Vec<_> = names("studies").collect();
        assert!(studies.is_sorted() && studies.contains(&"quick"), "{studies:?}");
        assert_eq!(names("stud").count(), 0);
    }
}
