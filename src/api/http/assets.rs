//! The files of the console, which are part of the program.

/// A file of the console.
pub(super) struct Asset {
    /// Its path below `/console/`.
    pub(super) path: &'static str,
    /// Its bytes.
    pub(super) bytes: &'static [u8],
}

impl Asset {
    /// The media type, by the ending of the path.
    pub(super) fn media_type(&self) -> &'static str {
        match self.path.rsplit_once('.') {
            Some((_, "html")) => "text/html; charset=utf-8",
            Some((_, "css")) => "text/css; charset=utf-8",
            Some((_, "js")) => "text/javascript; charset=utf-8",
            Some((_, "svg")) => "image/svg+xml",
            _ => "application/octet-stream",
        }
    }
}

macro_rules! assets {
    ($($path:literal,)*) => {
        [$(Asset {
            path: $path,
            bytes: include_bytes!(concat!("../../../console/", $path)),
        },)*]
    };
}

/// All files of the console.
pub(super) const ASSETS: &[Asset] = &assets![
    "index.html",
    "icon.svg",
    "style.css",
    "pages.css",
    "main.js",
    "api.js",
    "dom.js",
    "npz.js",
    "scene.js",
    "text.js",
    "pages/job.js",
    "pages/jobs.js",
    "pages/life.js",
    "pages/live.js",
    "pages/local.js",
    "pages/options.js",
    "pages/queue.js",
    "pages/sparkline.js",
    "pages/try.js",
    "viewer/camera.js",
    "viewer/card.js",
    "viewer/colors.js",
    "viewer/frame.js",
    "viewer/gestures.js",
    "viewer/legend.js",
    "viewer/lines.js",
    "viewer/matrix.js",
    "viewer/objects.js",
    "viewer/overlay.js",
    "viewer/panel.js",
    "viewer/picking.js",
    "viewer/picture.js",
    "viewer/renderer.js",
    "viewer/screenshot.js",
    "viewer/shaders.js",
    "viewer/viewer.css",
    "viewer/viewer.js",
];

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;
    use std::path::Path;

    use super::*;

    fn files(folder: &Path, prefix: &str, found: &mut BTreeSet<String>) {
        for entry in std::fs::read_dir(folder).expect("a folder") {
            let path = entry.expect("an entry").path();
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            if path.is_dir() {
                files(&path, &format!("{prefix}{name}/"), found);
            } else {
                found.insert(format!("{prefix}{name}"));
            }
        }
    }

    #[test]
    fn every_file_of_the_console_is_served() {
        let mut there = BTreeSet::new();
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("console");
        files(&folder, "", &mut there);
        let served: BTreeSet<String> = ASSETS.iter().map(|asset| asset.path.to_owned()).collect();
        assert_eq!(served, there);
        for asset in ASSETS {
            assert_ne!(
                asset.media_type(),
                "application/octet-stream",
                "{}",
                asset.path
            );
        }
    }
}
