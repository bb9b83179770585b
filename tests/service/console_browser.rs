//! Tests of the console in a real browser: files in, progress, the picture, refusals, keys and share
//! links. Each test fails if the page asks another host for anything, or violates its policy.

use std::path::{Path, PathBuf};
use std::time::Duration;

use fnsf::formats::CloudFormat;
use serde_json::Value;

use crate::browser::{Browser, Window};
use crate::clouds::{file, medium_pair, small_pair};
use crate::real_data::real_data;
use crate::server::{Folder, Server};

const WIDE: Window = Window(1400, 1000);

/// The viewer's state, as an expression.
const STATE: &str = "document.querySelector('.viewer')?.viewer?.state";
const VIEWER: &str = "document.querySelector('.viewer').viewer";

/// Two files with a pair: real sweeps if there are some.
fn pair_files(folder: &Path) -> Vec<PathBuf> {
    if let Some(data) = real_data() {
        let names = ["315966265259836000.feather", "315966265360032000.feather"];
        return names.map(|name| data.join("av2_7fab").join(name)).to_vec();
    }
    written(folder, medium_pair())
}

pub(crate) fn written(folder: &Path, pair: &[Vec<fnsf::flow::Point>; 2]) -> Vec<PathBuf> {
    let names = ["a <b>bold.pcd", "b.pcd"];
    let pair = names.iter().zip(pair).map(|(name, points)| {
        let path = folder.join(name);
        std::fs::write(&path, file(CloudFormat::Pcd, points)).expect("a file");
        path
    });
    pair.collect()
}

/// Drops the files of a pair, submits them, and waits for the picture of their flow.
pub(crate) async fn submitted(browser: &Browser, server: &Server, files: &[PathBuf]) {
    browser.open(&server.url("/")).await;
    browser.choose("files", files).await;
    browser.click("submit").await;
    browser.until("location.hash.startsWith('#/jobs/')").await;
}

pub(crate) async fn shows_flow(browser: &Browser) {
    let is_drawn = format!("{STATE}?.firstPictureMs && {STATE}.color === 'residual'");
    browser.until(&is_drawn).await;
    // One more picture, with what came last.
    let frames = browser.run(&format!("return {STATE}.frames")).await;
    browser
        .run("document.querySelector('.viewer').viewer.redraw()")
        .await;
    browser.until(&format!("{STATE}.frames > {frames}")).await;
}

/// Sets a range input, as a hand would.
async fn slide(browser: &Browser, test: &str, value: &str) {
    browser.find(test).await;
    let script = format!(
        "const range = document.querySelector(\"[data-test='{test}']\"); range.value = '{value}';
         range.dispatchEvent(new Event('input'))"
    );
    browser.run(&script).await;
}

async fn number(browser: &Browser, expression: &str) -> f64 {
    let value = browser.run(&format!("return {expression}")).await;
    value
        .as_f64()
        .unwrap_or_else(|| panic!("{expression} is {value}"))
}

#[tokio::test]
async fn two_files_become_a_picture_that_can_be_asked() {
    let Some(browser) = Browser::start(WIDE, true).await else {
        return;
    };
    let (server, folder) = (Server::start(&[]), Folder::new());
    submitted(&browser, &server, &pair_files(folder.path())).await;
    shows_flow(&browser).await;
    let picture = browser.picture("pair").await;
    assert!(picture.colorful(60) > 2_000, "{}", picture.colorful(60));
    assert!(picture.colors() > 500, "{}", picture.colors());

    // At the end of the slider the points of moving objects are elsewhere.
    slide(&browser, "time", "1").await;
    browser.until(&format!("{STATE}.time === 1")).await;

    // A click on the label of an object shows its numbers.
    let label = browser.css(".fv-label:not([hidden])").await;
    label.click().await.expect("a click");
    let card = browser.find("card").await.text().await.expect("text");
    for word in ["Speed", "km/h", "Size", "Confidence"] {
        assert!(card.contains(word), "{card}");
    }

    // So does a click on a point: the one in the middle of the first box.
    let boxes = browser.run(&format!("return {STATE}.boxes")).await;
    assert!(
        boxes.as_array().is_some_and(|boxes| !boxes.is_empty()),
        "{boxes}"
    );
    let script = "const viewer = document.querySelector('.viewer').viewer;
        const object = viewer.objects.find(({ cluster }) => viewer.state.boxes.some((box) => box.cluster === cluster));
        const row = viewer.frame.pair.cluster.indexOf(object.cluster);
        const place = viewer.frame.place(row, viewer.state.time, true);
        const { width, height, left, top } = viewer.canvas.getBoundingClientRect();
        const m = viewer.camera.matrix(width / height);
        const clip = [0, 1, 3].map((k) => m[k] * place[0] + m[4 + k] * place[1] + m[8 + k] * place[2] + m[12 + k]);
        const x = left + (0.5 + clip[0] / clip[2] / 2) * width, y = top + (0.5 - clip[1] / clip[2] / 2) * height;
        for (const type of ['pointerdown', 'pointerup'])
          viewer.canvas.dispatchEvent(new PointerEvent(type, { clientX: x, clientY: y, pointerId: 1, button: 0, bubbles: true }));
        return viewer.state.picked";
    let picked = browser.run(script).await;
    assert!(picked["row"].is_number(), "{picked}");
    let card = browser.find("card").await.text().await.expect("text");
    assert!(card.contains("Residual motion"), "{card}");

    // The threshold hides points and boxes.
    let shown = number(&browser, &format!("{STATE}.pointsDrawn")).await;
    slide(&browser, "confidence", "0.95").await;
    browser
        .until(&format!("{STATE}.pointsDrawn < {shown}"))
        .await;
    slide(&browser, "confidence", "0").await;
    browser.click("ground").await;
    browser
        .until(&format!("{STATE}.pointsDrawn < {shown}"))
        .await;
    for camera in ["top", "side", "driver", "free"] {
        browser.click(&format!("camera-{camera}")).await;
        let script = "document.querySelector('.viewer').viewer.camera.name";
        browser.until(&format!("{script} === '{camera}'")).await;
    }
    let frames = number(&browser, &format!("{STATE}.frames")).await;
    browser.click("play").await;
    browser
        .until(&format!("{STATE}.frames > {frames} + 3"))
        .await;
    browser.check_peace(&[]).await;
    browser.close().await;
}

#[tokio::test]
async fn progress_is_shown_and_a_job_can_be_cancelled() {
    let Some(browser) = Browser::start(WIDE, false).await else {
        return;
    };
    let (server, folder) = (Server::start(&[]), Folder::new());
    browser.open(&server.url("/")).await;
    let files = written(folder.path(), medium_pair());
    browser.choose("files", &files).await;
    // The names of files stay text.
    let listed = browser.css(".files").await.text().await.expect("text");
    assert!(listed.contains("<b>bold"), "{listed}");
    assert_eq!(
        browser
            .run("return document.querySelectorAll('.files b').length")
            .await,
        0
    );
    let script = "const preset = document.querySelector(\"[data-test='preset']\");
        preset.value = 'paper'; preset.dispatchEvent(new Event('change'));
        const labels = document.querySelector(\"[data-test='labels']\"); labels.value = 'note=<i>x</i>'";
    browser.run(script).await;
    browser.click("submit").await;
    let shows =
        "document.querySelector(\"[data-test='progress-text']\")?.textContent.includes('loss')";
    browser.until(shows).await;
    assert_eq!(
        browser
            .run("return document.querySelectorAll('main i:not(.phase)').length")
            .await,
        0
    );
    browser.click("cancel").await;
    let ended = "document.querySelector(\"[data-test='state']\")?.textContent === 'cancelled'";
    browser.until(ended).await;
    let label = browser.find("label").await.text().await.expect("text");
    assert_eq!(label, "note=<i>x</i>");
    // The list finds it by its label, and by its state alone.
    browser.open(&server.url("/#/jobs")).await;
    browser.css("tr[data-id]").await;
    let script = "const state = document.querySelector(\"[data-test='filter-state']\");
        state.value = 'succeeded'; state.dispatchEvent(new Event('change'))";
    browser.run(script).await;
    browser.until("document.querySelector('.empty')").await;
    browser.check_peace(&[]).await;
    browser.close().await;
}

#[tokio::test]
async fn a_refused_file_is_refused_in_words() {
    let Some(browser) = Browser::start(WIDE, false).await else {
        return;
    };
    let (server, folder) = (Server::start(&[]), Folder::new());
    let nonsense = folder.path().join("nonsense.pcd");
    std::fs::write(&nonsense, "not a cloud").expect("a file");
    browser.open(&server.url("/")).await;
    browser.choose("files", &[nonsense.clone(), nonsense]).await;
    browser.click("submit").await;
    let words = browser.find("refusal").await.text().await.expect("text");
    assert!(words.contains("source"), "{words}");
    browser.check_peace(&["422"]).await;
    browser.close().await;
}

#[tokio::test]
async fn a_key_opens_the_console_and_a_share_link_one_job_until_it_expires() {
    const KEY: &str = "key-of-the-writer-of-a";
    let Some(browser) = Browser::start(WIDE, false).await else {
        return;
    };
    let config = format!("[[keys]]\ntenant = \"a\"\nrole = \"write\"\nkey = \"{KEY}\"\n");
    let (server, folder) = (Server::with_config(&config), Folder::new());
    browser.open(&server.url("/")).await;
    for key in ["key-that-is-not-known", KEY] {
        let input = browser.find("key-input").await;
        input.clear().await.expect("cleared");
        input.send_keys(key).await.expect("typed");
        browser.click("key-save").await;
        if key != KEY {
            let complains = "document.querySelector('dialog')?.innerText.includes('does not know')";
            browser.until(complains).await;
        }
    }
    browser
        .choose("files", &written(folder.path(), small_pair()))
        .await;
    browser.click("submit").await;
    browser.click("share").await;
    let link = browser.find("share-link").await;
    let link = link.property("value").await.expect("a value");
    let link = link.as_str().expect("a link");
    // The key is kept for the tab alone.
    let stored = browser
        .run("return Object.values(localStorage).join()")
        .await;
    assert!(!stored.to_string().contains(KEY));

    let short = {
        let path = link.split('#').nth(1).unwrap_or_default();
        let job = path.split(['/', '?']).nth(2).expect("a job").to_owned();
        let url = server.url(&format!("/v1/jobs/{job}/share?seconds=1"));
        let answer = reqwest::Client::new().post(url).bearer_auth(KEY).send();
        let link: Value = answer.await.expect("an answer").json().await.expect("JSON");
        server.url(link["path"].as_str().expect("a path"))
    };
    browser.check_peace(&["401"]).await;
    browser.close().await;

    // Another browser, without the key.
    let browser = Browser::start(WIDE, false).await.expect("a browser");
    browser.open(link).await;
    shows_flow(&browser).await;
    assert_eq!(
        browser
            .run("return document.querySelectorAll('nav a').length")
            .await,
        0
    );
    for action in ["cancel", "remove", "share"] {
        let found = format!("return document.querySelectorAll(\"[data-test='{action}']\").length");
        assert_eq!(browser.run(&found).await, 0, "{action}");
    }
    tokio::time::sleep(Duration::from_millis(1100)).await;
    browser.open("about:blank").await;
    browser.open(&short).await;
    let words = browser.find("failure").await.text().await.expect("text");
    assert!(words.contains("expired"), "{words}");
    browser.check_peace(&["401"]).await;
    browser.close().await;
}

#[tokio::test]
async fn the_pages_are_accessible_in_light_dark_and_narrow_windows() {
    let Some(path) = std::env::var_os("FNSF_AXE") else {
        let is_required =
            std::env::var_os("FNSF_REQUIRE_BROWSER").is_some_and(|value| value == "1");
        assert!(!is_required, "FNSF_AXE names no file: npm pack axe-core");
        eprintln!("FNSF_AXE is not set: the accessibility of the console is not tested");
        return;
    };
    let axe = std::fs::read_to_string(path).expect("the file that FNSF_AXE names");
    let (server, folder) = (Server::start(&[]), Folder::new());
    for (window, is_dark) in [(WIDE, false), (WIDE, true), (Window(500, 900), false)] {
        let Some(browser) = Browser::start(window, is_dark).await else {
            return;
        };
        submitted(&browser, &server, &written(folder.path(), medium_pair())).await;
        shows_flow(&browser).await;
        let job = browser.run("return location.hash").await;
        let job = job.as_str().expect("text").to_owned();
        for page in ["#/", "#/jobs", "#/queue", &job] {
            browser.open(&server.url(&format!("/{page}"))).await;
            if page == job {
                shows_flow(&browser).await;
            }
            browser
                .until("document.querySelector('main h1') && !document.querySelector('.loading')")
                .await;
            browser.run(&axe).await;
            let check = "axe.run(document, { resultTypes: ['violations'] }).then(arguments[0])";
            let found = browser.run_until_called(check).await;
            let violations = found["violations"].as_array().cloned().unwrap_or_default();
            let serious: Vec<String> = violations
                .iter()
                .filter(|one| one["impact"] == "serious" || one["impact"] == "critical")
                .map(|one| format!("{}: {}", one["id"], one["nodes"][0]["html"]))
                .collect();
            assert_eq!(serious, [""; 0], "{page} {window:?} dark: {is_dark}");
        }
        browser.close().await;
    }
}

#[tokio::test]
async fn a_sequence_plays_with_its_tracks() {
    let Some(browser) = Browser::start(WIDE, true).await else {
        return;
    };
    let server = Server::start(&[]);
    browser.open(&server.url("/")).await;
    let script = "document.querySelector(\"[data-test='street-sweeps']\").value = '5'";
    browser.find("street").await;
    browser.run(script).await;
    browser.click("street").await;
    browser.until("location.hash.startsWith('#/jobs/')").await;
    let ended = "document.querySelector(\"[data-test='state']\")?.textContent === 'succeeded'";
    browser.until(ended).await;
    browser.until(&format!("{STATE}?.hasTracks")).await;
    slide(&browser, "sweep", "3").await;
    browser.until(&format!("{STATE}.sweep === 3")).await;
    let tracked = format!("{STATE}.boxes.some((box) => box.id !== null)");
    browser.until(&tracked).await;
    let picture = browser.picture("sequence").await;
    assert!(picture.colorful(60) > 1_000, "{}", picture.colorful(60));
    browser.click("play").await;
    browser.until(&format!("{STATE}.sweep !== 3")).await;
    browser.click("play").await;
    browser.until(&format!("!{STATE}.isPlaying")).await;

    // The picked object is the same one in the next sweep.
    slide(&browser, "sweep", "1").await;
    browser
        .until(&format!("{STATE}.sweep === 1 && {tracked}"))
        .await;
    let pick = format!(
        "{VIEWER}.pickObject({VIEWER}.objects.find((object) => object.id !== null)); \
         return {STATE}.picked.id"
    );
    let picked = browser.run(&pick).await;
    slide(&browser, "sweep", "2").await;
    let same = format!("{STATE}.sweep === 2 && {STATE}.picked.id === {picked}");
    browser.until(&same).await;
    let card = browser.run(&format!("return {VIEWER}.card.hidden")).await;
    assert_eq!(card, true, "its numbers are of another sweep");

    // The last sweep has no flow.
    slide(&browser, "sweep", "4").await;
    let legend = "document.querySelector('.fv-legend').textContent.includes('height')";
    browser.until(legend).await;

    browser.run("document.querySelector('.skip').click()").await;
    let stays = "document.activeElement.id === 'page' && location.hash.startsWith('#/jobs/')";
    browser.until(stays).await;
    browser.until(&format!("{STATE}.sweep === 4")).await;

    // A browser without WebGL2 is told so, and nothing else.
    browser
        .run(
            "const context = HTMLCanvasElement.prototype.getContext;
             HTMLCanvasElement.prototype.getContext = function (kind, ...more) {
               return kind === 'webgl2' ? null : context.call(this, kind, ...more);
             };
             dispatchEvent(new HashChangeEvent('hashchange'));",
        )
        .await;
    let told = "document.querySelector('.fv-message')?.textContent.includes('WebGL2')";
    browser.until(told).await;
    browser
        .run(&format!("return {VIEWER}.reload().then(() => true)"))
        .await;
    browser.until(told).await;
    browser.check_peace(&[]).await;
    browser.close().await;
}
