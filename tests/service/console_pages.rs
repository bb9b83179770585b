//! Tests of the console's pages in a real browser: what stays while they are updated, what is told to
//! those who do not look, and what becomes of an upload whose page is left.

use serde_json::json;

use crate::browser::{Browser, Window};
use crate::clouds::{ENDLESS, accepted, form, medium_pair, small_pair};
use crate::console_browser::{shows_flow, submitted, written};
use crate::server::{Folder, Server};

const WIDE: Window = Window(1400, 1000);

#[tokio::test]
async fn the_focus_stays_while_a_page_is_updated() {
    let Some(browser) = Browser::start(WIDE, false).await else {
        return;
    };
    let server = Server::start(&[]);
    let submit = || {
        let request = reqwest::Client::new().post(server.url("/v1/jobs"));
        accepted(request.multipart(form(small_pair(), ENDLESS)))
    };
    let first = submit().await;
    let id = first["id"].as_str().expect("an id");
    browser.open(&server.url("/#/jobs")).await;
    let focused = format!("document.activeElement.closest(\"tr[data-id='{id}']\")");
    let focus = format!("document.querySelector(\"tr[data-id='{id}'] button\").focus()");
    browser.css(&format!("tr[data-id='{id}'] button")).await;
    browser.run(&focus).await;
    browser.until(&focused).await;
    // A job that comes before it moves its row and leaves the focus.
    submit().await;
    browser
        .until("document.querySelectorAll('tr[data-id]').length === 2")
        .await;
    browser.until(&focused).await;
    browser.until("document.title === 'Jobs · fnsf'").await;

    browser.open(&server.url("/#/queue")).await;
    browser.css("[role='region']").await;
    browser
        .run("document.querySelector(\"[role='region']\").focus()")
        .await;
    let points = "document.querySelector('polyline')?.getAttribute('points').split(' ').length";
    browser.until(&format!("{points} > 2")).await;
    browser
        .until("document.activeElement.getAttribute('role') === 'region'")
        .await;

    // The page that a link has led to, and a button of it.
    browser.open(&server.url(&format!("/#/jobs/{id}"))).await;
    browser.until("document.activeElement.id === 'page'").await;
    browser.until("document.title.startsWith('Job ')").await;
    browser.find("cancel").await;
    browser
        .run("document.querySelector(\"[data-test='cancel']\").focus()")
        .await;
    let shows =
        "document.querySelector(\"[data-test='progress-text']\")?.textContent.includes('loss')";
    browser.until(shows).await;
    browser
        .until("document.activeElement.dataset.test === 'cancel'")
        .await;
    browser.check_peace(&[]).await;
    browser.close().await;
}

#[tokio::test]
async fn an_update_keeps_elements_by_their_key_and_menus_open() {
    let Some(browser) = Browser::start(WIDE, false).await else {
        return;
    };
    let server = Server::start(&[]);
    browser.open(&server.url("/")).await;
    let script = "const done = arguments[0];
        Promise.all([import('/console/dom.js'), import('/console/text.js')]).then(([{ el, update }, { duration }]) => {
          const said = [];
          const row = (id, text) => el('li', { data: { id }, on: { click: () => said.push(text) } }, text);
          const menu = (text) => el('details', { data: { id: 'menu' } }, el('summary', {}, text), el('div', {}, text));
          const list = el('ul', {});
          update(list, row('a', 'A'), menu('one'), row('b', 'B'));
          const [a, open, b] = list.children;
          open.open = true;
          update(list, row('c', 'C'), row('b', 'B again'), menu('two'), null, [el('li', { class: 'new' }, 'D')]);
          list.children[1].click();
          done({
            same: [list.children[1] === b, list.children[2] === open, open.open, a.isConnected],
            texts: [...list.children].map((child) => child.textContent),
            classes: list.lastChild.className,
            said,
            durations: [0.2, 0.9996, 12.34, 59.97, 119.7, 3600].map(duration),
          });
        });";
    let found = browser.run_until_called(script).await;
    let expected = json!({
        "same": [true, true, true, false],
        "texts": ["C", "B again", "twotwo", "D"],
        "classes": "new",
        "said": ["B again"],
        "durations": ["200 ms", "1.00 s", "12.3 s", "1 min 0 s", "2 min 0 s", "1 h 0 min"],
    });
    assert_eq!(found, expected);
    browser.close().await;
}

#[tokio::test]
async fn an_upload_whose_page_is_left_goes_on_and_tells_its_job() {
    let Some(browser) = Browser::start(WIDE, false).await else {
        return;
    };
    let (server, folder) = (Server::start(&[]), Folder::new());
    browser.open(&server.url("/")).await;
    let files = written(folder.path(), medium_pair());
    browser.choose("files", &files).await;
    browser
        .run("document.querySelector(\"[data-test='submit']\").click(); location.hash = '#/jobs'")
        .await;
    let told = "document.querySelector('.notice a')?.hash.startsWith('#/jobs/')";
    browser.until(told).await;
    browser.until("location.hash === '#/jobs'").await;
    browser
        .run("document.querySelector('.notice a').click()")
        .await;
    browser.find("downloads").await;
    browser.check_peace(&[]).await;
    browser.close().await;
}

#[tokio::test]
async fn objects_are_picked_by_the_keyboard_hidden_points_by_nothing_and_pictures_have_their_legend()
 {
    let Some(browser) = Browser::start(WIDE, false).await else {
        return;
    };
    let (server, folder) = (Server::start(&[]), Folder::new());
    submitted(&browser, &server, &written(folder.path(), medium_pair())).await;
    shows_flow(&browser).await;
    let viewer = "document.querySelector('.viewer').viewer";
    browser
        .until(&format!("{viewer}?.state.boxes.length > 0"))
        .await;
    let key = format!(
        "{viewer}.canvas.dispatchEvent(new KeyboardEvent('keydown', {{ key: 'o' }}));
         return {viewer}.card.innerText"
    );
    let card = browser.run(&key).await;
    assert!(card.to_string().contains("km/h"), "{card}");
    let drawn = "const texts = [];
        const fillText = CanvasRenderingContext2D.prototype.fillText;
        CanvasRenderingContext2D.prototype.fillText = function (text, ...more) { texts.push(text); fillText.call(this, text, ...more); };
        document.querySelector(\"[data-test='screenshot']\").click();
        CanvasRenderingContext2D.prototype.fillText = fillText;
        return texts";
    let texts = browser.run(drawn).await;
    let texts = texts.as_array().expect("texts");
    let is_there = |is: fn(&str) -> bool| texts.iter().any(|text| text.as_str().is_some_and(is));
    assert!(
        is_there(|text| text.starts_with("full color") && text.ends_with(" m")),
        "{texts:?}"
    );
    assert!(is_there(|text| text.ends_with("m/s")), "{texts:?}");

    // Points that are not drawn are not picked.
    let pick = format!(
        "const viewer = {viewer};
         const {{ left, top, width, height }} = viewer.canvas.getBoundingClientRect();
         let hits = 0;
         for (let x = 0.1; x < 1; x += 0.05) for (let y = 0.1; y < 1; y += 0.05) {{
           viewer.state.picked = null;
           for (const type of ['pointerdown', 'pointerup'])
             viewer.canvas.dispatchEvent(new PointerEvent(type, {{ clientX: left + x * width, clientY: top + y * height,
               pointerId: 1, button: 0, bubbles: true }}));
           hits += viewer.state.picked !== null;
         }}
         return hits"
    );
    let hits = browser.run(&pick).await;
    assert!(hits.as_u64().is_some_and(|hits| hits > 10), "{hits}");
    for layer in ["layer-moved", "layer-source"] {
        let hides = format!(
            "const box = document.querySelector(\"[data-test='{layer}']\");
             if (box.checked) box.click()"
        );
        browser.run(&hides).await;
    }
    assert_eq!(browser.run(&pick).await, json!(0));
    browser.check_peace(&[]).await;
    browser.close().await;
}
