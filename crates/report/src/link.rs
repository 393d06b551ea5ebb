//! Links from one page to another.

use std::ffi::OsStr;
use std::fmt::Write;
use std::path::{Component, Path, PathBuf};

/// A link to another page.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Link {
    /// What it says.
    pub text: String,
    /// Relative address.
    pub href: String,
}

impl Link {
    /// From a page in the folder `from` to a file, so that both can be moved together. `None` where no relative path
    /// leads there: from another drive, or where the working directory is not known.
    pub fn to_file(from: &Path, file: &Path, text: &str) -> Option<Link> {
        let [from, file] = [from, file].map(|path| std::path::absolute(path).ok().map(|path| without_detours(&path)));
        let (from, file) = (from?, file?);
        let (mut here, mut there) = (from.components().peekable(), file.components().peekable());
        if here.peek()? != there.peek()? {
            return None;
        }
        while here.peek().is_some_and(|name| there.peek() == Some(name)) {
            here.next();
            there.next();
        }
        let names: Vec<String> = here.map(|_| "..".into()).chain(there.map(|name| encoded(name.as_os_str()))).collect();
        Some(Link { text: text.into(), href: names.join("/") })
    }
}

/// A path without `..` inside, as browsers read addresses.
fn without_detours(path: &Path) -> PathBuf {
    path.components().fold(PathBuf::new(), |mut path, part| {
        match part {
            Component::ParentDir => _ = path.pop(),
            Component::CurDir => {}
            part => path.push(part),
        }
        path
    })
}

/// A name as a part of an address.
fn encoded(name: &OsStr) -> String {
    name.as_encoded_bytes().iter().fold(String::new(), |mut text, byte| {
        match byte {
            b'a'..=b'z' | b'A'..=b'Z' | b'0'..=b'9' | b'-' | b'.' | b'_' | b'~' => text.push(char::from(*byte)),
            byte => _ = write!(text, "%{byte:02X}"),
        }
        text
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_link_is_relative_and_holds_no_sign_of_an_address() {
        for (from, file, href) in [
            ("/a/runs/twin", "/a/twins/drive/diagnosis/report.html", "../../twins/drive/diagnosis/report.html"),
            ("/a/out/detectors", "/a/out/report.html", "../report.html"),
            ("/a/out", "/a/out/detectors/report.html", "detectors/report.html"),
            ("/a/configs/../out", "/a/./b/../out 1/100%#?.html", "../out%201/100%25%23%3F.html"),
        ] {
            let link = Link::to_file(Path::new(from), Path::new(file), "text").unwrap();
            assert_eq!(link.href, href, "{from} {file}");
        }
        let here = Link::to_file(Path::new("runs/one"), Path::new("runs/two/report.html"), "text").unwrap();
        assert_eq!((here.href.as_str(), here.text.as_str()), ("../two/report.html", "text"));
    }
}
