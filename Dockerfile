# docker build -t polcap . && docker run --rm --user "$(id -u):$(id -g)" -v "$PWD/capture:/capture" polcap process /capture
FROM python:3.13-slim
COPY . /src
RUN pip install --no-cache-dir '/src[batch,usd]' && rm -rf /src && useradd --uid 1000 --create-home polcap
USER 1000
WORKDIR /home/polcap
ENTRYPOINT ["polcap"]
CMD ["--help"]
