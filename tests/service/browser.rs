//! A real browser: Chromium without a window, driven by its driver.

use std::collections::BTreeMap;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use serde_json::{Value, json};

use crate::server::PATIENCE;
use crate::webdriver::{Element, Session};

/// A browser with one open page. It is closed on drop.
pub(crate) struct Browser {
    driver: Child,
    page: Session,
}

/// Size of the window.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Window(pub(crate) u32, pub(crate) u32);

impl Browser {
    /// Starts one. Without a driver the test is skipped with a message, unless
    /// `FNSF_REQUIRE_BROWSER=1` makes it fail.
    pub(crate) async fn start(window: Window, is_dark: bool) -> Option<Self> {
        let is_there = Command::new("chromedriver")
            .arg("--version")
            .stdout(Stdio::null())
            .status()
            .is_ok_and(|status| status.success());
        let is_required =
            std::env::var_os("FNSF_REQUIRE_BROWSER").is_some_and(|value| value == "1");
        assert!(
            is_there || !is_required,
            "FNSF_REQUIRE_BROWSER is set and there is no chromedriver: install chromium-driver"
        );
        if !is_there {
            eprintln!("chromedriver is not installed: the console is not tested in a browser");
            return None;
        }
        let free = TcpListener::bind("127.0.0.1:0").expect("a port");
        let port = free.local_addr().expect("an address").port();
        drop(free);
        let driver = Command::new("chromedriver")
            .arg(format!("--port={port}"))
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .expect("the driver starts");
        let Window(width, height) = window;
        let mut arguments = vec![
            "--headless=new".to_owned(),
            "--no-sandbox".to_owned(),
            "--use-angle=swiftshader".to_owned(),
            "--enable-unsafe-swiftshader".to_owned(),
            format!("--window-size={width},{height}"),
        ];
        if is_dark {
            arguments.push("--blink-settings=preferredColorScheme=0".to_owned());
        }
        let capabilities = json!({
            "browserName": "chrome",
            "goog:chromeOptions": { "args": arguments },
            "goog:loggingPrefs": { "browser": "ALL" },
        });
        let address = format!("http://127.0.0.1:{port}");
        let began = Instant::now();
        loop {
            match Session::open(&address, &capabilities).await {
                Ok(page) => return Some(Self { driver, page }),
                Err(error) => assert!(began.elapsed() < PATIENCE, "no browser: {error}"),
            }
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
    }

    /// Opens an address.
    pub(crate) async fn open(&self, url: &str) {
        let opened = self.page.post("/url", json!({ "url": url })).await;
        opened.expect("a page");
    }

    /// The element with this `data-test`, when it is there.
    pub(crate) async fn find(&self, test: &str) -> Element<'_> {
        self.css(&format!("[data-test='{test}']")).await
    }

    /// The first element that a CSS selector selects, when it is there.
    pub(crate) async fn css(&self, selector: &str) -> Element<'_> {
        let began = Instant::now();
        loop {
            match self.page.find(selector).await {
                Ok(element) => return element,
                Err(error) => assert!(
                    error.is_of_a_missing_element() && began.elapsed() < PATIENCE,
                    "{selector} does not appear: {error}"
                ),
            }
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    }

    /// Clicks the element with this `data-test`. It is found again if the page has just replaced it.
    pub(crate) async fn click(&self, test: &str) {
        let began = Instant::now();
        while let Err(error) = self.find(test).await.click().await {
            assert!(
                error.is_of_a_missing_element() && began.elapsed() < PATIENCE,
                "{test} cannot be clicked: {error}"
            );
        }
    }

    /// Puts files into the file input with this `data-test`.
    pub(crate) async fn choose(&self, test: &str, files: &[PathBuf]) {
        let names: Vec<_> = files.iter().map(|file| file.to_string_lossy()).collect();
        let sent = self.find(test).await.send_keys(&names.join("\n")).await;
        sent.expect("the files are taken");
    }

    /// Runs a script in the page, as the body of a function, and returns what it returns.
    pub(crate) async fn run(&self, script: &str) -> Value {
        let ran = self.page.run(script, false).await;
        ran.unwrap_or_else(|error| panic!("{script} fails: {error}"))
    }

    /// Runs a script that calls `arguments[0]` with what it returns.
    pub(crate) async fn run_until_called(&self, script: &str) -> Value {
        let ran = self.page.run(script, true).await;
        ran.unwrap_or_else(|error| panic!("{script} fails: {error}"))
    }

    /// Waits until a script, an expression, is true.
    pub(crate) async fn until(&self, expression: &str) {
        let began = Instant::now();
        while self.run(&format!("return Boolean({expression})")).await != json!(true) {
            if began.elapsed() > PATIENCE {
                let text = self.run("return document.body.innerText").await;
                panic!(
                    "it is not so that {expression}: {:?}, {text}",
                    self.log().await
                );
            }
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    }

    /// Errors in the page's console since the last call, and violations of its policy.
    pub(crate) async fn log(&self) -> Vec<String> {
        let entries = self
            .page
            .post("/se/log", json!({ "type": "browser" }))
            .await;
        let entries = entries.expect("a log");
        let entries = entries.as_array().cloned().unwrap_or_default();
        let severe = entries.iter().filter(|entry| entry["level"] == "SEVERE");
        severe
            .map(|entry| entry["message"].as_str().unwrap_or_default().to_owned())
            .collect()
    }

    /// Asserts that the page has asked no other host for anything, and that its console has no
    /// error but those that contain one of `expected`.
    pub(crate) async fn check_peace(&self, expected: &[&str]) {
        let script = "return performance.getEntriesByType('resource').map((entry) => entry.name)
            .filter((name) => !name.startsWith(location.origin) && !name.startsWith('blob:'))";
        assert_eq!(self.run(script).await, json!([]), "other hosts are asked");
        let mut log = self.log().await;
        log.retain(|entry| !expected.iter().any(|expected| entry.contains(expected)));
        assert_eq!(log, [""; 0]);
    }

    /// Takes a picture of the window, keeps it in `target/screenshots`, and counts its pixels by
    /// color.
    pub(crate) async fn picture(&self, name: &str) -> Picture {
        let encoded = self.page.get("/screenshot").await.expect("a picture");
        let encoded = encoded.as_str().expect("text");
        let bytes = STANDARD.decode(encoded).expect("Base64");
        let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("../screenshots");
        std::fs::create_dir_all(&folder).expect("a folder");
        std::fs::write(folder.join(format!("{name}.png")), &bytes).expect("a file");
        Picture::of(&bytes)
    }

    /// Closes the browser.
    pub(crate) async fn close(self) {
        self.page.close().await.expect("it closes");
    }
}

impl Drop for Browser {
    fn drop(&mut self) {
        let _is_gone = self.driver.kill();
        let _ended = self.driver.wait();
    }
}

/// A picture of the window.
pub(crate) struct Picture {
    colors: BTreeMap<[u8; 3], usize>,
}

impl Picture {
    fn of(png: &[u8]) -> Self {
        let mut decoder = png::Decoder::new(std::io::Cursor::new(png));
        decoder.set_transformations(png::Transformations::EXPAND | png::Transformations::STRIP_16);
        let mut reader = decoder.read_info().expect("a PNG");
        let mut pixels = vec![0; reader.output_buffer_size().expect("a size")];
        let info = reader.next_frame(&mut pixels).expect("pixels");
        let channels = info.color_type.samples();
        let mut colors = BTreeMap::new();
        for pixel in pixels[..info.buffer_size()].chunks_exact(channels) {
            let color = [pixel[0], pixel[1 % channels], pixel[2 % channels]];
            *colors.entry(color).or_default() += 1;
        }
        Self { colors }
    }

    /// Number of pixels whose color is saturated: the difference of its largest and its smallest
    /// channel is at least `least`.
    pub(crate) fn colorful(&self, least: u8) -> usize {
        let is_colorful = |[red, green, blue]: [u8; 3]| {
            red.max(green).max(blue) - red.min(green).min(blue) >= least
        };
        let colorful = self.colors.iter().filter(|(color, _)| is_colorful(**color));
        colorful.map(|(_, pixels)| pixels).sum()
    }

    /// Number of different colors.
    pub(crate) fn colors(&self) -> usize {
        self.colors.len()
    }
}
