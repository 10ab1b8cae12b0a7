"""Reads a page of `harness report` in a real headless Chromium, as a person would: chooses, points, types, plays.

    read_page.py PAGE RESULTS CHROMIUM CHROMEDRIVER [--hostile | --quiet | --horizon | --robot] [--screenshots DIR]

RESULTS is the folder that the page was made of; what the page shows is compared with its tables, read by pandas.
With --hostile, names on the page try to run scripts that set `window.hostile`, and only that is looked at. With
--quiet, only whether the page asks for anything, while the browser shows a page of its own beside it. With --robot, the
page is about experiments in any world. Ends with an error at the first thing that is not as it should be.
"""

import argparse
import base64
import json
import re
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pandas as pd
from scipy.stats import t as student
from selenium import webdriver
from selenium.common.exceptions import SessionNotCreatedException
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import Select

PATIENCE_S = 300

DESKTOP = (1280, 900)
PHONE = (360, 740)
SECTIONS = ["scenes", "claims", "joints", "regression", "figures", "training", "runs"]


def start(options: webdriver.ChromeOptions, driver: str) -> webdriver.Chrome:
    """Starts a browser. On a busy machine it may give up before it has started, so it is tried a few times."""
    for _ in range(2):
        try:
            return webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
        except SessionNotCreatedException as error:
            print(error)
    return webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))


def open_browser(chromium: str, driver: str, profile: str) -> webdriver.Chrome:
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for argument in ["--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
                     "--disable-background-networking", "--disable-component-update", "--disable-sync",
                     "--disable-dev-shm-usage", "--hide-scrollbars", f"--user-data-dir={profile}"]:
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    browser = start(options, driver)
    browser.set_script_timeout(PATIENCE_S)
    # The first tab is the browser's, which loads what it likes there.
    browser.switch_to.new_window("tab")
    return browser


class Page:
    """The page in the browser."""

    def __init__(self, browser: webdriver.Chrome, path: Path, screenshots: Path | None):
        self.browser, self.path, self.screenshots = browser, path, screenshots
        self.browsers_tab = browser.window_handles[0]

    def open(self, size: tuple[int, int], dark: bool = False):
        width, height = size
        phone = size == PHONE
        self.browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", {
            "width": width, "height": height, "deviceScaleFactor": 2 if phone else 1, "mobile": phone})
        self.browser.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": phone, "maxTouchPoints": 5})
        # With reduced motion, nothing scrolls smoothly. A click would miss during smooth scrolling.
        features = {"prefers-color-scheme": "dark" if dark else "light", "prefers-reduced-motion": "reduce"}
        self.browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {
            "features": [{"name": name, "value": value} for name, value in features.items()]})
        # A mouse that rests on a chart after scrolling would point at it, even while fingers touch it.
        self.browser.execute_cdp_cmd("Input.dispatchMouseEvent", {"type": "mouseMoved", "x": 0, "y": 0})
        # Requests that the browser itself made before do not count.
        self.browser.get_log("performance")
        self.browser.get(self.path.as_uri())

    def run(self, script: str, *arguments):
        return self.browser.execute_script(script, *arguments)

    def draw(self):
        """Waits until the browser has drawn the page as it is now. Pointers and fingers act on what is drawn."""
        self.run("return new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")

    def one(self, selector: str):
        return self.browser.find_element(By.CSS_SELECTOR, selector)

    def all(self, selector: str):
        return self.browser.find_elements(By.CSS_SELECTOR, selector)

    def select(self, section: str, label: str) -> Select:
        place = f"//section[@id='{section}']//label[starts-with(normalize-space(.), '{label}')]/select"
        return Select(self.browser.find_element(By.XPATH, place))

    def choose(self, section: str, label: str, value):
        self.select(section, label).select_by_value(str(value))

    def tooltip(self, section: str) -> str:
        return self.one(f"#{section} .tooltip").text

    def wait(self, condition: Callable[[], object], what: object):
        """Waits until a condition is met. Touches reach the page after the browser has answered."""
        end = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < end, what
            time.sleep(0.02)

    def wait_for_tooltip(self, section: str, said: str):
        self.wait(lambda: self.tooltip(section) == said, f"the tooltip never says {said}")

    def press(self, section: str, *keys: str) -> str:
        """Presses keys in a chart, and returns what its tooltip says then."""
        self.one(f"#{section} .plot").send_keys(*keys)
        return self.tooltip(section)

    def points(self, section: str) -> list[str]:
        """What the tooltip says of each point of a chart's first series, by the keyboard."""
        said = [self.press(section, Keys.ESCAPE, Keys.ARROW_RIGHT, Keys.HOME)]
        while (more := self.press(section, Keys.ARROW_RIGHT)) != said[-1]:
            said.append(more)
        return said

    def series(self, section: str) -> list[str]:
        """The names of the series that a chart shows, by the keyboard."""
        said = [self.press(section, Keys.ESCAPE, Keys.ARROW_RIGHT).splitlines()[0]]
        while (more := self.press(section, Keys.ARROW_DOWN).splitlines()[0]) not in said:
            said.append(more)
        return said

    def place(self, section: str) -> tuple[float, float]:
        """Where the point that the tooltip describes is in the window."""
        chart = self.one(f"#{section} .plot")
        self.run("arguments[0].scrollIntoView({block: 'center', behavior: 'instant'})", chart)
        self.draw()
        script = ("const box = document.querySelector(arguments[0]).getBoundingClientRect();"
                  "return [box.x + box.width / 2, box.y + box.height / 2]")
        x, y = self.run(script, f"#{section} .ring")
        return x, y

    def point_at(self, x: float, y: float):
        pointer = ActionChains(self.browser, duration=20).w3c_actions
        pointer.pointer_action.move_to_location(round(x), round(y))
        pointer.perform()
        self.draw()

    def touch(self, *fingers: list[tuple[float, float]]):
        """Moves fingers from place to place on the screen, all at the same time."""
        def send(kind: str, places: list[tuple[float, float]]):
            points = [{"x": x, "y": y, "id": number} for number, (x, y) in enumerate(places)]
            self.browser.execute_cdp_cmd("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
        first, *others = zip(*fingers)
        send("touchStart", first)
        for places in others:
            send("touchMove", places)
        send("touchEnd", [])
        self.draw()

    def colors(self, section: str, x: float, y: float) -> set[str]:
        """The colors that a chart has drawn within two pixels of a place in the window."""
        script = """
            const canvas = document.querySelector(arguments[0]);
            const box = canvas.getBoundingClientRect();
            const ratio = canvas.width / box.width;
            const [x, y] = [(arguments[1] - box.x - 2) * ratio, (arguments[2] - box.y - 2) * ratio];
            const copy = new OffscreenCanvas(5 * ratio, 5 * ratio).getContext("2d", { willReadFrequently: true });
            copy.drawImage(canvas, -Math.round(x), -Math.round(y));
            const { data } = copy.getImageData(0, 0, 5 * ratio, 5 * ratio);
            const found = new Set();
            for (let at = 0; at < data.length; at += 4) {
                if (data[at + 3] === 255) found.add(`rgb(${data.slice(at, at + 3).join(", ")})`);
            }
            return [...found];"""
        return set(self.run(script, f"#{section} canvas:not(.legend canvas)", x, y))

    def color_of(self, name: str) -> str:
        """The color of a variable of the style sheet."""
        return self.run("const probe = document.body.appendChild(document.createElement('i'));"
                        "probe.style.color = `var(--${arguments[0]})`;"
                        "const { color } = getComputedStyle(probe); probe.remove(); return color", name)

    def shoot(self, name: str, selector: str | None = None):
        """Saves a picture of the whole page, of one element, or of what the window shows."""
        if not self.screenshots:
            return
        if selector == "window":
            self.browser.save_screenshot(str(self.screenshots / f"{name}.png"))
            return
        target = "document.documentElement" if selector is None else f"document.querySelector('{selector}')"
        box = self.run(f"const b = {target}.getBoundingClientRect();"
                       "return {x: b.x + scrollX, y: b.y + scrollY, width: b.width, height: b.height}")
        clip = {**box, "scale": 1}
        picture = self.browser.execute_cdp_cmd("Page.captureScreenshot", {
            "format": "png", "clip": clip, "captureBeyondViewport": True})
        self.screenshots.joinpath(f"{name}.png").write_bytes(base64.b64decode(picture["data"]))

    def check_quiet(self):
        """No script failed, nothing was refused, and nothing was asked of any network."""
        complaints = [entry for entry in self.browser.get_log("browser")
                      if entry["level"] == "SEVERE" and not entry["message"].startswith("chrome")]
        assert not complaints, complaints
        for entry in map(json.loads, (entry["message"] for entry in self.browser.get_log("performance"))):
            message = entry["message"]
            if entry["webview"] != self.browsers_tab and message["method"] == "Network.requestWillBeSent":
                url = message["params"]["request"]["url"]
                assert url.split(":")[0] in ("file", "data"), url


def table(results: Path, name: str) -> pd.DataFrame:
    return pd.concat(pd.read_parquet(path) for path in sorted(results.glob(f"runs/*/*/{name}.parquet")))


def number(text: str) -> float:
    return float(text.replace("\u2212", "-"))


def check_joints(page: Page, metrics: pd.DataFrame):
    """Every choice is there, and what a point says is what the tables have."""
    rows = metrics[(metrics.experiment == "single_to_multi") & (metrics.task == "prediction")
                   & (metrics.model == "network")]
    latents = sorted(rows.latent.unique())
    for scenario in ["empty", "cluttered"]:
        for latent in latents[:2]:
            for modality, metric in [("proprioception", "r2"), ("contact_force", "mae")]:
                for label, value in [("Of", modality), ("Metric", metric), ("Scenario", scenario), ("Latent", latent)]:
                    page.choose("joints", label, value)
                said = page.points("joints")[-1]
                assert said.startswith("from proprioception, "), said
                joint = int(re.search(rf"(?:joint|link) (\d+), latent size {latent}\n", said)[1])
                values = rows[(rows.scenario == scenario) & (rows.latent == latent) & (rows.modality == modality)
                              & (rows.metric == metric) & (rows["index"] == joint)].value
                words = {"r2": "R²", "mae": "MAE"}[metric]
                shown = re.search(rf"{words} (\S+)(?: \[(\S+), (\S+)\])?", said)
                assert abs(number(shown[1]) - values.mean()) <= 1e-3 * abs(values.mean()), (said, values.mean())
                if len(values) > 1:
                    half = student.ppf(0.975, len(values) - 1) * values.sem()
                    low, high = number(shown[2]), number(shown[3])
                    assert abs((high - low) / 2 - half) <= 2e-3 * max(half, abs(values.mean())), (said, half)
                    assert f"over {len(values)} seeds" in said, said

    names = [entry.text for entry in page.all("#joints .legend li")]
    # A line for each direction.
    both = page.series("joints")
    assert len(names) == len(set(names)) and len(both) == 2 * len(names), (names, both)
    page.choose("joints", "Direction", "fe")
    assert len(page.series("joints")) == len(names)
    page.choose("joints", "Direction", "both")
    page.choose("joints", "Over", "latent")
    assert not page.one("#joints .choices label:last-child").is_displayed(), "the axis shows every latent size"
    shown = [re.search(r"latent size (\d+)", said)[1] for said in page.points("joints")]
    assert shown == [str(latent) for latent in latents], shown
    page.choose("joints", "Over", "joint")


def choose_forces(page: Page):
    """Chooses errors that lie within the axis, because marks at its ends may hide each other."""
    for label, value in [("Of", "contact_force"), ("Metric", "mae"), ("Direction", "fe")]:
        page.choose("joints", label, value)


def check_keys(page: Page):
    """The arrow keys go from point to point, and Escape leaves."""
    said = [page.press("joints", key) for key in [Keys.ESCAPE, Keys.ARROW_RIGHT, Keys.ARROW_RIGHT, Keys.ARROW_DOWN]]
    assert said[0] == "" and all(said[1:]) and len(set(said)) == 4, said
    assert page.press("joints", Keys.ESCAPE) == ""


def check_pointer(page: Page):
    """The pointer shows the point that is drawn there. Dragging zooms and pans."""
    choose_forces(page)
    said = page.press("joints", Keys.ESCAPE, Keys.ARROW_RIGHT, Keys.HOME, Keys.ARROW_RIGHT)
    x, y = page.place("joints")
    assert page.color_of("first") in page.colors("joints", x, y)
    page.press("joints", Keys.ESCAPE)
    page.point_at(x, y)
    page.wait_for_tooltip("joints", said)
    page.shoot("desktop-pointed", "window")

    def drag(start: tuple[float, float], by: float, *keys: str):
        page.point_at(*start)
        chain = ActionChains(page.browser, duration=20)
        for key in keys:
            chain.key_down(key)
        chain.click_and_hold().move_by_offset(round(by), 0).perform()
        # uPlot looks at the pointer once in every frame.
        page.draw()
        chain = ActionChains(page.browser, duration=20).release()
        for key in keys:
            chain.key_up(key)
        chain.perform()

    def place_of_point() -> float:
        page.press("joints", Keys.ESCAPE, Keys.ARROW_RIGHT, Keys.HOME, Keys.ARROW_RIGHT)
        return page.place("joints")[0]

    drag((x - 60, y), 160)
    zoomed = place_of_point()
    assert zoomed > x + 50, (x, zoomed)
    page.shoot("desktop-zoomed", "window")
    drag((zoomed, y), -120, Keys.SHIFT)
    assert abs(place_of_point() - (zoomed - 120)) < 3

    def shows_everything_after_double_click() -> bool:
        page.point_at(x, y)
        ActionChains(page.browser).double_click().perform()
        return abs(place_of_point() - x) < 1

    # On a busy machine, the second click may come too late.
    page.wait(shows_everything_after_double_click, "a double click does not show everything")
    page.press("joints", "+", "+")
    assert abs(place_of_point() - x) > 5
    page.press("joints", "0")
    assert abs(place_of_point() - x) < 1

    # When the metric changes, the zoom of x is kept, but not that of y, because the values are others.
    page.choose("joints", "Metric", "wmape")
    before = place_of_point(), page.place("joints")[1]
    page.choose("joints", "Metric", "r2")
    page.press("joints", Keys.ESCAPE, "+", "+")
    page.choose("joints", "Metric", "wmape")
    after = place_of_point(), page.place("joints")[1]
    assert abs(after[0] - before[0]) > 5 and abs(after[1] - before[1]) < 1, (before, after)
    page.press("joints", "0")
    page.choose("joints", "Metric", "mae")
    page.choose("joints", "Direction", "both")


def check_legend(page: Page):
    """A click on a name hides its series, and another one shows them."""
    button = page.one("#joints .legend button")
    name, all_series = button.text, page.series("joints")
    x, y = page.place("joints") if page.press("joints", Keys.ESCAPE, Keys.ARROW_RIGHT) else (0, 0)
    button.click()
    assert button.get_attribute("aria-pressed") == "false"
    left = page.series("joints")
    assert left == [series for series in all_series if not series.startswith(f"{name},")] != all_series, left
    assert page.color_of("first") not in page.colors("joints", x, y)
    button.click()
    assert button.get_attribute("aria-pressed") == "true" and page.series("joints") == all_series


def check_regression(page: Page, predictions: pd.DataFrame):
    """A dot is a row of the predictions table."""
    page.choose("regression", "Of", "contact_force")
    page.choose("regression", "Direction", "aa")
    latent = int(page.select("regression", "Latent").options[0].get_attribute("value"))
    page.choose("regression", "Latent", latent)
    study = page.select("regression", "Predicted").first_selected_option.get_attribute("value")
    scenario = page.select("regression", "Scenario").first_selected_option.get_attribute("value")
    said = page.press("regression", Keys.ESCAPE, *(15 * [Keys.ARROW_RIGHT]))
    reference, predicted = (number(re.search(rf"{word} (\S+) N", said)[1]) for word in ["reference", "predicted"])
    episode, sample, seed = map(int, re.search(r"episode (\d+), sample (\d+), seed (\d+)", said).groups())
    row = predictions[(predictions.experiment == study) & (predictions.scenario == scenario)
                      & (predictions.latent == latent) & (predictions.task == "prediction")
                      & (predictions.modality == "contact_force") & (predictions["index"] == 19)
                      & (predictions.seed == seed) & (predictions.episode == episode)
                      & (predictions["sample"] == sample)]
    assert len(row) == 1, said
    for shown, stored in [(reference, row.reference.item()), (predicted, row.predicted.item())]:
        assert abs(shown - stored) <= 1e-3 * abs(stored) + 1e-9, (said, stored)


def check_training(page: Page, epochs: pd.DataFrame):
    """Each term has a chart with the table's values, and says how far it still fell at the end."""
    run = page.select("training", "Run").first_selected_option.get_attribute("value")
    stored = epochs[(epochs.run == run) & (epochs.task == "prediction") & (epochs.split == "train")]
    terms = [chart.get_attribute("data-term") for chart in page.all("#training figure")]
    assert sorted(terms) == sorted(stored.term.unique()) and (terms[0], terms[-1]) == ("total", "kl"), terms
    chart = page.one("#training figure[data-term=kl]")
    values = [stored[(stored.term == "kl") & (stored.epoch == epoch)].value.item() for epoch in [1, 2]]
    chart.find_element(By.CSS_SELECTOR, ".plot").send_keys(Keys.ARROW_RIGHT)
    said = chart.find_element(By.CSS_SELECTOR, ".tooltip").text
    assert said.splitlines()[0] == "training" and run in said, said
    assert abs(number(re.search(r"epoch 1: (\S+)", said)[1]) - values[0]) <= 1e-3 * abs(values[0]), (said, values)
    # Of two epochs, the last tenth is the second.
    said = chart.find_element(By.CSS_SELECTOR, ".aside").text
    change = number(re.search(r"training \S+ \(([+\u2212]?[\d.]+) %\)", said)[1])
    assert abs(change - 100 * (values[1] / values[0] - 1)) <= 0.1, (said, values)
    pictures = set()
    for scale in ["linear", "logarithmic"]:
        page.choose("training", "Scale", scale)
        charts = page.run("return [...document.querySelectorAll('#training .plot canvas')]"
                          ".map((one) => one.toDataURL())")
        assert len(charts) == len(terms)
        pictures.update(charts)
    assert len(pictures) == 2 * len(terms), "the scales look the same"


@contextmanager
def altered(page: Page, alter: Callable[[dict], None]) -> Iterator[Page]:
    """The page with other data."""
    before, rest = page.path.read_text().split('id="data">', 1)
    text, after = rest.split("</script>", 1)
    data = json.loads(text)
    alter(data)
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder, "report.html")
        copy.write_text(f'{before}id="data">{json.dumps(data)}</script>{after}')
        other = Page(page.browser, copy, None)
        other.open(DESKTOP)
        yield other


def check_missing_losses(page: Page):
    """Epochs without a loss are left out of the means at the end."""
    def alter(data: dict):
        for run in data["training"]:
            run["epochs"] = list(range(1, 21))
            for splits in run["terms"].values():
                # Without the missing ones, the mean of the last tenth is 3, and that of the tenth before is 4.
                splits["train"] = 16 * [9] + [4, None, None, 3]
                splits["validation"] = 18 * [9] + [None, None]

    with altered(page, alter) as other:
        said = other.one("#training figure[data-term=kl] .aside").text
    assert "training 3 (\u221225.0 %)" in said and "validation has no value" in said, said


def check_directions(page: Page):
    """The direction of a joint is that of the data, not that of its number."""
    def alter(data: dict):
        for row in data["joints"]:
            row["directions"] = 10 * ["fe"] + 10 * ["aa"]

    with altered(page, alter) as other:
        other.choose("joints", "Direction", "fe")
        joints = [int(re.search(r"(?:joint|link) (\d+)", said)[1]) for said in other.points("joints")]
    assert joints and max(joints) < 10 and {joint % 2 for joint in joints} == {0, 1}, joints


def check_many_studies(page: Page):
    """Each of many experiments has its own look."""
    names = [f"experiment {number}" for number in range(20)]

    def alter(data: dict):
        study = data["joints"][0]["study"]
        rows = [row for row in data["joints"] if row["study"] == study]
        data["joints"] = [{**row, "study": name, "input": name} for name in names for row in rows]

    with altered(page, alter) as other:
        looks = other.run(
            "return [...document.querySelectorAll('#joints .legend button')]"
            ".map((one) => [one.textContent, one.querySelector('canvas').toDataURL()])")
    assert set(names) < {name for name, _ in looks}, looks
    networks = [look for name, look in looks if name in names]
    assert len(set(networks)) == len(names), len(set(networks))


def check_clip(page: Page):
    button = page.one(".clip button")
    page.wait(lambda: page.all(".clip canvas"), "the clip is not decoded")
    def picture() -> str:
        return page.run("return document.querySelector('.clip canvas').toDataURL()")
    before = picture()
    button.click()
    assert button.text == "Pause"
    page.wait(lambda: picture() != before, "the clip does not play")
    button.click()
    still = picture()
    time.sleep(0.3)
    assert button.text == "Play" and picture() == still


def check_claims(page: Page):
    claim = page.one("details.claim")
    query = claim.find_element(By.TAG_NAME, "pre")
    assert not query.is_displayed()
    claim.find_element(By.TAG_NAME, "summary").send_keys(Keys.ENTER)
    assert query.is_displayed() and query.text.startswith("select"), query.text


def check_width(page: Page):
    """The page, with everything open, is no wider than the screen."""
    page.run("document.querySelectorAll('details').forEach((details) => (details.open = true))")
    width = page.run("return document.documentElement.scrollWidth")
    wide = page.run(
        "return [...document.querySelectorAll('body *')]"
        ".filter((e) => e.getBoundingClientRect().right > innerWidth + 0.5"
        " && !e.closest('pre') && !e.closest('svg')).map((e) => e.outerHTML.slice(0, 200))")
    assert width <= page.run("return innerWidth") and not wide, (width, wide[:5])


def luminance(color: str) -> float:
    parts = [int(part) / 255 for part in re.findall(r"\d+", color)[:3]]
    linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def check_contrast(page: Page, selector: str, least: float):
    """Text stands out from the ground by the ratio that WCAG defines."""
    colors = page.run(
        "return [getComputedStyle(document.querySelector(arguments[0])).color,"
        " getComputedStyle(document.body).backgroundColor]", selector)
    light, dark = sorted(map(luminance, colors), reverse=True)
    assert (light + 0.05) / (dark + 0.05) >= least, (selector, colors)
    return colors


def read_on_desktop(page: Page, metrics: pd.DataFrame, predictions: pd.DataFrame, epochs: pd.DataFrame):
    page.open(DESKTOP)
    for section in SECTIONS:
        assert page.one(f"#{section} h2").is_displayed(), section
        page.shoot(f"desktop-{section}", f"#{section}")
    assert len(page.all("#figures .paper > svg")) + len(page.all("#figures .absent")) == 9
    page.shoot("desktop")
    check_joints(page, metrics)
    check_keys(page)
    check_pointer(page)
    check_legend(page)
    check_regression(page, predictions)
    page.shoot("desktop-pointed-regression", "window")
    check_training(page, epochs)
    check_clip(page)
    check_claims(page)
    check_width(page)
    check_contrast(page, "p", 7)
    page.check_quiet()


def read_on_phone(page: Page):
    page.open(PHONE)
    page.shoot("phone")
    last = page.select("joints", "Latent").options[-1].get_attribute("value")
    page.choose("joints", "Latent", last)
    said = page.press("joints", Keys.ESCAPE, Keys.END)
    x, y = page.place("joints")
    page.press("joints", Keys.ESCAPE)
    def says_the_same_after_touch() -> bool:
        page.touch([(x, y)])
        end = time.monotonic() + 10
        while (same := page.tooltip("joints") == said) is False and time.monotonic() < end:
            time.sleep(0.02)
        return same

    # On a busy machine, a touch may last too long.
    page.wait(says_the_same_after_touch, f"a touch never says {said}")
    assert f"latent size {last}" in said, said
    page.shoot("phone-pointed", "window")
    # Two fingers zoom, and one finger moves what they have enlarged.
    middle, y = PHONE[0] / 2, y - 60

    def place_after(*keys: str) -> float:
        page.press("joints", *keys)
        return page.place("joints")[0]

    to_a_point = [Keys.ESCAPE, *(6 * [Keys.ARROW_RIGHT])]
    before = place_after(*to_a_point)
    page.touch([(middle - 20 - step, y) for step in range(0, 50, 10)],
               [(middle + 20 + step, y) for step in range(0, 50, 10)])
    page.wait(lambda: abs(place_after(*to_a_point) - before) > 5, "two fingers do not zoom")
    zoomed = place_after(*to_a_point)
    page.touch([(middle + step, y) for step in range(0, 50, 10)])
    page.shoot("phone-zoomed", "window")
    back_and_forth = [Keys.ARROW_RIGHT, Keys.ARROW_LEFT]
    page.wait(lambda: abs(place_after(*back_and_forth) - zoomed) > 20, "a finger does not move the plot")
    page.press("joints", "0")
    check_width(page)
    page.shoot("phone-open")
    page.check_quiet()


def read_in_the_dark(page: Page):
    page.open(DESKTOP)
    _, light = check_contrast(page, "p", 7)
    page.open(DESKTOP, dark=True)
    _, dark = check_contrast(page, "p", 7)
    assert dark != light, "the dark has a ground of its own"
    for selector in [".verdict", ".aside", ".legend button", "nav a"]:
        check_contrast(page, selector, 4.5)
    choose_forces(page)
    page.press("joints", Keys.ESCAPE, Keys.ARROW_RIGHT, Keys.ARROW_RIGHT)
    x, y = page.place("joints")
    dark_blue = page.color_of("first")
    assert dark_blue in page.colors("joints", x, y)
    # A reader who turns on the light sees charts in the colors of the light.
    preference = {"name": "prefers-color-scheme", "value": "light"}
    page.browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [preference]})
    page.draw()
    assert dark_blue not in page.colors("joints", x, y) and page.color_of("first") in page.colors("joints", x, y)
    page.open(DESKTOP, dark=True)
    page.shoot("dark")
    page.check_quiet()


def read_hostile(page: Page):
    """Checks that hostile text is shown as text, runs no script and adds no image."""
    page.open(DESKTOP)
    check_width(page)
    assert page.run("return window.hostile") is None
    assert page.run("return document.querySelectorAll('img[src=x], [onerror]').length") == 0
    assert page.run("return document.scripts.length") == 2
    for section in ["claims", "training", "runs"]:
        assert "<script>window.hostile=1" in page.one(f"#{section}").get_attribute("textContent"), section
    page.check_quiet()


def read_horizon(page: Page, results: Path):
    """The curves over the horizon are those of the tables, on a desktop and on a phone."""
    tables = [table(results, name) for name in ["metrics", "further_metrics"]]
    rows = pd.concat([tables[0].assign(horizon=1), tables[1]])
    rows = rows[(rows.task == "prediction") & rows["index"].isna() & rows.direction.isna() & (rows.model == "network")]
    for size in [DESKTOP, PHONE]:
        page.open(size)
        for modality in ["contact_force", "proprioception"]:
            page.choose("horizon", "Of", modality)
            page.choose("horizon", "Metric", "r2")
            points = page.points("horizon")
            values = rows[(rows.modality == modality) & (rows.metric == "r2")].groupby("horizon").value.mean()
            assert len(points) == len(values) == 3, points
            for said, (horizon, value) in zip(points, values.items()):
                assert said.startswith("network\n") and f"{number(str(horizon / 10)):g} s ahead" in said, said
                assert abs(number(re.search(r"R² (\S+)", said)[1]) - value) <= 1e-3 * max(1, abs(value)), (said, value)
            page.choose("horizon", "Metric", "skill")
            assert page.series("horizon") == ["network", "ridge", "training mean"]
        assert page.run("return document.documentElement.scrollWidth <= innerWidth"), size
        page.shoot(f"horizon-{size[0]}", "#horizon")
    page.check_quiet()


def check_choices(page: Page, section: str):
    """Every choice of every select of a chart shows points."""
    script = f"return [...document.querySelectorAll('#{section} label:not([hidden]) select')].map((one) => one.length)"
    for place, options in enumerate(page.run(script)):
        for option in range(options):
            select = Select(page.all(f"#{section} label:not([hidden]) select")[place])
            select.select_by_index(option)
            said = page.press(section, Keys.ESCAPE, Keys.HOME)
            # A metric may not be defined for an element.
            assert said or "R\u00b2" in page.one(f"#{section} .choices").text, (section, place, option)
        Select(page.all(f"#{section} label:not([hidden]) select")[place]).select_by_index(0)


def read_robot(page: Page):
    """The page of any robot: every part is shown, fits a desktop and a phone, and can be touched."""
    for size in [DESKTOP, PHONE]:
        page.open(size)
        sections = page.run("return [...document.querySelectorAll('main section')].map((one) => one.id)")
        assert {"modalities", "metrics", "joints", "training", "runs"} <= set(sections), sections
        for section in sections:
            assert page.one(f"#{section} h2").is_displayed(), section
            page.shoot(f"robot-{size[0]}-{section}", f"#{section}")
        for section in {"joints", "regression", "course"} & set(sections):
            check_choices(page, section)
        page.shoot(f"robot-{size[0]}")
        page.run("document.querySelectorAll('details').forEach((details) => (details.open = true))")
        width = page.run("return document.documentElement.scrollWidth")
        assert width <= size[0], width
        small = page.run("""
            const targets = [...document.querySelectorAll("button, select, input, summary, nav a")];
            const boxes = targets.map((one) => [one.outerHTML.slice(0, 120), one.getBoundingClientRect()]);
            return boxes.filter(([, {width, height}]) => width > 0 && Math.min(width, height) < 24)
                .map(([text, {width, height}]) => `${text} ${width} x ${height}`);""")
        assert size == DESKTOP or not small, small[:5]
    page.check_quiet()


def read_quiet(page: Page):
    pages_tab = page.browser.current_window_handle
    page.browser.switch_to.window(page.browsers_tab)
    page.browser.get("chrome://new-tab-page/")
    page.browser.switch_to.window(pages_tab)
    page.open(DESKTOP)
    page.check_quiet()


def main():
    parser = argparse.ArgumentParser()
    for name in ["page", "results"]:
        parser.add_argument(name, type=Path)
    for name in ["chromium", "chromedriver"]:
        parser.add_argument(name)
    parser.add_argument("--hostile", action="store_true")
    parser.add_argument("--quiet", action="store_true")
    parser.add_argument("--horizon", action="store_true")
    parser.add_argument("--robot", action="store_true")
    parser.add_argument("--screenshots", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        browser = open_browser(arguments.chromium, arguments.chromedriver, profile)
        try:
            page = Page(browser, arguments.page.resolve(), arguments.screenshots)
            if arguments.hostile:
                read_hostile(page)
            elif arguments.quiet:
                read_quiet(page)
            elif arguments.horizon:
                read_horizon(page, arguments.results)
            elif arguments.robot:
                read_robot(page)
            else:
                tables = [table(arguments.results, name) for name in ["metrics", "predictions", "epochs"]]
                read_on_desktop(page, *tables)
                read_on_phone(page)
                read_in_the_dark(page)
                check_missing_losses(page)
                check_directions(page)
                check_many_studies(page)
        finally:
            browser.quit()
    print("the page reads well")


if __name__ == "__main__":
    main()
