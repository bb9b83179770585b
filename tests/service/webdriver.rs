//! A client of the WebDriver protocol (W3C), as far as the tests of the console need it.

use serde_json::{Value, json};

use crate::server::name_cryptography;

/// The protocol's key of an element's identity.
const ELEMENT: &str = "element-6066-11e4-a52e-4f735466cecf";

/// A refusal of the driver: the protocol's error code, and words.
#[derive(Debug)]
pub(crate) struct Refusal {
    code: String,
    message: String,
}

impl std::fmt::Display for Refusal {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}: {}", self.code, self.message)
    }
}

impl Refusal {
    /// Whether the element has been replaced or is not there (yet).
    pub(crate) fn is_of_a_missing_element(&self) -> bool {
        ["stale element reference", "no such element"].contains(&self.code.as_str())
    }
}

/// An open page of a browser.
pub(crate) struct Session {
    http: reqwest::Client,
    url: String,
}

impl Session {
    /// Opens a browser by the driver at `driver`.
    pub(crate) async fn open(driver: &str, capabilities: &Value) -> Result<Self, Refusal> {
        name_cryptography();
        let new = Self {
            http: reqwest::Client::new(),
            url: format!("{driver}/session"),
        };
        let asked = json!({ "capabilities": { "alwaysMatch": capabilities } });
        let opened = new.post("", asked).await?;
        let id = opened["sessionId"].as_str().expect("a session");
        Ok(Self {
            url: format!("{}/{id}", new.url),
            ..new
        })
    }

    /// Sends a command.
    pub(crate) async fn post(&self, command: &str, body: Value) -> Result<Value, Refusal> {
        let url = format!("{}{command}", self.url);
        answer(self.http.post(url).json(&body)).await
    }

    /// Asks for a property.
    pub(crate) async fn get(&self, command: &str) -> Result<Value, Refusal> {
        answer(self.http.get(format!("{}{command}", self.url))).await
    }

    /// Runs a script as the body of a function. It ends by calling its last argument if `waits`.
    pub(crate) async fn run(&self, script: &str, waits: bool) -> Result<Value, Refusal> {
        let kind = if waits { "async" } else { "sync" };
        let body = json!({ "script": script, "args": [] });
        self.post(&format!("/execute/{kind}"), body).await
    }

    /// The first element that a CSS selector selects.
    pub(crate) async fn find(&self, selector: &str) -> Result<Element<'_>, Refusal> {
        let by = json!({ "using": "css selector", "value": selector });
        let found = self.post("/element", by).await?;
        let id = found[ELEMENT].as_str().expect("an element");
        Ok(Element {
            session: self,
            path: format!("/element/{id}"),
        })
    }

    /// Closes the browser.
    pub(crate) async fn close(&self) -> Result<Value, Refusal> {
        answer(self.http.delete(&self.url)).await
    }
}

/// An element of the page.
pub(crate) struct Element<'a> {
    session: &'a Session,
    path: String,
}

impl Element<'_> {
    pub(crate) async fn click(&self) -> Result<(), Refusal> {
        let command = format!("{}/click", self.path);
        self.session.post(&command, json!({})).await.map(drop)
    }

    pub(crate) async fn clear(&self) -> Result<(), Refusal> {
        let command = format!("{}/clear", self.path);
        self.session.post(&command, json!({})).await.map(drop)
    }

    /// Types a text, or puts the files of these paths into a file input: one path a line.
    pub(crate) async fn send_keys(&self, text: &str) -> Result<(), Refusal> {
        let command = format!("{}/value", self.path);
        let typed = self.session.post(&command, json!({ "text": text })).await;
        typed.map(drop)
    }

    /// The text that is shown.
    pub(crate) async fn text(&self) -> Result<String, Refusal> {
        let text = self.session.get(&format!("{}/text", self.path)).await?;
        Ok(text.as_str().unwrap_or_default().to_owned())
    }

    /// A property of the element's object, such as `value`.
    pub(crate) async fn property(&self, name: &str) -> Result<Value, Refusal> {
        let command = format!("{}/property/{name}", self.path);
        self.session.get(&command).await
    }
}

/// The value of the driver's answer.
async fn answer(request: reqwest::RequestBuilder) -> Result<Value, Refusal> {
    let failed = |error: reqwest::Error| Refusal {
        code: "no answer".to_owned(),
        message: error.to_string(),
    };
    let response = request.send().await.map_err(failed)?;
    let status = response.status();
    let mut answer: Value = response.json().await.map_err(failed)?;
    let value = answer["value"].take();
    if status.is_success() {
        return Ok(value);
    }
    let text = |name: &str| value[name].as_str().unwrap_or_default().to_owned();
    Err(Refusal {
        code: text("error"),
        message: text("message"),
    })
}
