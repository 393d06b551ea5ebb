//! A small server with as much of S3 as reading needs, which fails on demand.

use std::collections::BTreeMap;
use std::hash::{DefaultHasher, Hash as _, Hasher as _};
use std::io::{BufRead as _, BufReader, Write as _};
use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};
use std::sync::{Arc, Mutex};

/// The objects of the bucket `drives`, by name, and what goes wrong.
#[derive(Default)]
pub struct Server {
    pub objects: Mutex<BTreeMap<String, Vec<u8>>>,
    /// Requests that are answered with 503 from now on.
    pub busy: AtomicUsize,
    /// Bodies that end before half of them was sent.
    pub cut: AtomicUsize,
    /// Every request is answered with this status.
    pub refused: AtomicUsize,
    pub requests: AtomicUsize,
}

fn once(counter: &AtomicUsize) -> bool {
    counter.fetch_update(Relaxed, Relaxed, |left| left.checked_sub(1)).is_ok()
}

impl Server {
    /// Starts a server on this machine; its address.
    pub fn start() -> (Arc<Server>, String) {
        let (server, listener) = (Arc::new(Server::default()), TcpListener::bind("127.0.0.1:0").unwrap());
        let (address, shared) = (listener.local_addr().unwrap(), server.clone());
        std::thread::spawn(move || {
            for stream in listener.incoming() {
                let server = shared.clone();
                std::thread::spawn(move || server.serve(&stream.unwrap()));
            }
        });
        (server, format!("http://{address}"))
    }

    fn serve(&self, stream: &TcpStream) {
        let mut lines = BufReader::new(stream).lines().map_while(Result::ok);
        while let Some(request) = lines.next() {
            let headers: Vec<String> = lines.by_ref().take_while(|line| !line.is_empty()).collect();
            let header = |name: &str| {
                let line = headers.iter().find(|line| line.to_ascii_lowercase().starts_with(&format!("{name}:")));
                line.map(|line| line[name.len() + 1..].trim().to_string())
            };
            self.requests.fetch_add(1, Relaxed);
            let mut words = request.split(' ');
            let (method, target) = (words.next().unwrap(), words.next().unwrap());
            let (path, query) = target.split_once('?').unwrap_or((target, ""));
            let (status, more, body) = self.answer(path.trim_start_matches('/'), query, &header);
            let head = format!(
                "HTTP/1.1 {status} -\r\ncontent-length: {}\r\nlast-modified: Wed, 25 Nov 2026 07:00:00 GMT\r\n{more}\r\n",
                body.len()
            );
            let mut out = head.into_bytes();
            if method != "HEAD" {
                let is_cut = status == 206 && once(&self.cut);
                out.extend(&body[..if is_cut { body.len() / 2 } else { body.len() }]);
                if is_cut {
                    let _ = (&mut &*stream).write_all(&out);
                    return drop(stream.shutdown(std::net::Shutdown::Both));
                }
            }
            if (&mut &*stream).write_all(&out).is_err() {
                return;
            }
        }
    }

    /// Status, more headers and body.
    fn answer(&self, path: &str, query: &str, header: &dyn Fn(&str) -> Option<String>) -> (usize, String, Vec<u8>) {
        let error = |status, code: &str| (status, String::new(), format!("<Error><Code>{code}</Code></Error>").into());
        if once(&self.busy) {
            return error(503, "SlowDown");
        }
        match self.refused.load(Relaxed) {
            0 => {}
            status => return error(status, "AccessDenied"),
        }
        let Some(key) = path.strip_prefix("drives").map(|key| key.trim_start_matches('/')) else {
            return error(404, "NoSuchBucket");
        };
        let objects = self.objects.lock().unwrap();
        let tag = |bytes: &[u8]| {
            let mut hash = DefaultHasher::new();
            bytes.hash(&mut hash);
            format!("\"{:x}\"", hash.finish())
        };
        if query.contains("list-type=2") {
            let prefix =
                query.split('&').find_map(|part| part.strip_prefix("prefix=")).unwrap_or("").replace("%2F", "/");
            let entry = |(name, bytes): (&String, &Vec<u8>)| {
                let rest = name.strip_prefix(&prefix)?;
                Some(match rest.split_once('/') {
                    Some((folder, _)) => format!("<CommonPrefixes><Prefix>{prefix}{folder}/</Prefix></CommonPrefixes>"),
                    None => format!(
                        "<Contents><Key>{name}</Key><LastModified>2026-11-25T07:00:00.000Z</LastModified><ETag>{}</ETag>\
                         <Size>{}</Size></Contents>",
                        tag(bytes).replace('"', "&quot;"),
                        bytes.len()
                    ),
                })
            };
            let entries: String = objects.iter().filter_map(entry).collect();
            let text = format!("<ListBucketResult><IsTruncated>false</IsTruncated>{entries}</ListBucketResult>");
            return (200, "content-type: application/xml\r\n".into(), text.into());
        }
        let Some(bytes) = objects.get(key) else { return error(404, "NoSuchKey") };
        let tag = tag(bytes);
        if header("if-match").is_some_and(|wanted| wanted != tag) {
            return error(412, "PreconditionFailed");
        }
        let range = header("range").and_then(|range| {
            let (first, last) = range.strip_prefix("bytes=")?.split_once('-')?;
            Some((first.parse::<usize>().ok()?, last.parse::<usize>().ok()?.min(bytes.len() - 1)))
        });
        match range {
            None => (200, format!("etag: {tag}\r\n"), bytes.clone()),
            Some((first, last)) => {
                let more = format!("etag: {tag}\r\ncontent-range: bytes {first}-{last}/{}\r\n", bytes.len());
                (206, more, bytes[first..=last].to_vec())
            }
        }
    }

    /// Puts the files of a folder into the bucket, with names that begin with `prefix`.
    pub fn put_folder(&self, folder: &Path, prefix: &str) {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            let name = format!("{prefix}/{}", path.file_name().unwrap().to_str().unwrap());
            if path.is_dir() {
                self.put_folder(&path, &name);
            } else {
                self.objects.lock().unwrap().insert(name, std::fs::read(path).unwrap());
            }
        }
    }
}
